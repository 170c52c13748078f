// The controls over the picture: time, what is shown, and the object that was clicked.

const find = (id) => document.getElementById(id);

function element(kind, text, properties = {}) {
  return Object.assign(document.createElement(kind), { textContent: text, ...properties });
}

// The bar below the picture. `state` has second, playing, speed and following; change(part) alters it and redraws.
// Returns update(), which shows the state.
function timeBar(state, span, keyFrames, change) {
  const [slider, play] = [find("time"), find("play")];
  Object.assign(slider, { min: span[0], max: span[1], step: 0.01 });
  const jump = (frames) => frames.length && change({ second: frames[0], playing: false });
  const toggle = () => change({ playing: !state.playing });
  slider.addEventListener("input", () => change({ second: Number(slider.value), playing: false }));
  play.addEventListener("click", toggle);
  find("next").addEventListener("click", () => jump(keyFrames.filter((at) => at > state.second + 1e-3)));
  find("previous").addEventListener("click", () => jump(keyFrames.filter((at) => at < state.second - 1e-3).reverse()));
  find("speed").addEventListener("change", (e) => change({ speed: Number(e.target.value) }));
  find("follow").addEventListener("change", (e) => change({ following: e.target.checked }));
  addEventListener("keydown", (e) => {
    if (e.code !== "Space" || e.target.matches("button, select")) return;
    e.preventDefault();
    toggle();
  });
  return () => {
    slider.value = state.second;
    play.textContent = state.playing ? "Pause" : "Play";
    find("follow").checked = state.following;
    find("followed").textContent = state.edit && state.edit.camera ? "edited camera" : "recorded camera";
    find("clock").textContent = `${state.second.toFixed(2)} s`;
  };
}

function instanceLabel({ id, samples, category }, ids) {
  return samples ? `${category || "object"} ${shortId(id, ids)}` : id;
}

// A box to tick for boxes, the path of the camera, the sky and each instance. Returns fill(instances), for another
// drive.
function shownList(state, hasSky, change) {
  const list = find("list");
  const add = (text, checked, set) => {
    const box = element("input", "", { type: "checkbox", checked });
    box.addEventListener("change", () => { set(box.checked); change({}); });
    const label = element("label", "");
    label.append(box, ` ${text}`);
    list.append(label);
  };
  return (instances) => {
    list.replaceChildren();
    const ids = instances.map(({ id }) => id);
    if (instances.some(({ samples, size }) => samples && size)) add("boxes", state.boxes, (on) => (state.boxes = on));
    add("path of the camera", state.path, (on) => (state.path = on));
    if (hasSky) add("sky", state.sky, (on) => (state.sky = on));
    instances.forEach((instance) => add(instanceLabel(instance, ids), !state.hidden.has(instance.id), (on) => {
      if (on) state.hidden.delete(instance.id);
      else state.hidden.add(instance.id);
    }));
  };
}

// What is known of a clicked instance, and the step of an edit that removes it.
function showPicked(instance, ids, speed) {
  find("picked").hidden = !instance;
  if (!instance) return;
  const size = instance.size.map((metres) => metres.toFixed(1)).join(" x ");
  find("about").textContent = `${instance.category} ${instance.id} · ${speed.toFixed(1)} m/s · ${size} m`;
  find("step").textContent = `- remove: {track: "${shortId(instance.id, ids)}"}`;
}

function followCopy() {
  find("copy").addEventListener("click", () => {
    const step = find("step");
    getSelection().selectAllChildren(step); // where the page may not write to the clipboard, the user copies it
    navigator.clipboard?.writeText(step.textContent).catch(() => {});
  });
}

// What mouse, keys and fingers do: shown until the view is moved by hand, and again on request.
function hints() {
  const hint = find("hint");
  const fingers = matchMedia("(pointer: coarse)").matches;
  hint.textContent = fingers
    ? "One finger: look · two fingers: move and zoom · tap: pick an object"
    : "Drag: look · right drag: orbit · shift drag: pan · wheel or W A S D Q E: move · R: back to the start · " +
      "space: play · click: pick an object";
  find("help").addEventListener("click", () => (hint.hidden = !hint.hidden));
  return () => (hint.hidden = true);
}
