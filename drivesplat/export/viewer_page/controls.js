// The controls over the picture: time, what is shown, and the object that was clicked.

const find = (id) => document.getElementById(id);

function element(kind, text, properties = {}) {
  return Object.assign(document.createElement(kind), { textContent: text, ...properties });
}

// The bar below the picture. `state` has second, playing, speed and following; change(part) alters it and redraws.
function timeBar(state, [first, last], keyFrames, change) {
  const [slider, play] = [find("time"), find("play")];
  Object.assign(slider, { min: first, max: last, step: 0.01 });
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
    find("clock").textContent = `${state.second.toFixed(2)} s`;
  };
}

function groupLabel(group) {
  return group.samples ? `${group.category || "object"} ${group.name.slice(0, 8)}` : group.name;
}

// A box to tick for boxes, the recorded path, the sky and each group.
function shownList(state, groups, hasSky, change) {
  const list = find("list");
  const add = (text, checked, set) => {
    const box = element("input", "", { type: "checkbox", checked });
    box.addEventListener("change", () => { set(box.checked); change({}); });
    const label = element("label", "");
    label.append(box, ` ${text}`);
    list.append(label);
  };
  if (groups.some((group) => group.samples && group.size)) add("boxes", false, (on) => (state.boxes = on));
  add("recorded path", false, (on) => (state.path = on));
  if (hasSky) add("sky", state.sky, (on) => (state.sky = on));
  groups.forEach((group, number) => add(groupLabel(group), true, (on) => {
    if (on) state.hidden.delete(number);
    else state.hidden.add(number);
  }));
}

// What is known of a clicked object, and the step of an edit that removes it.
function showPicked(group, speed) {
  find("picked").hidden = !group;
  if (!group) return;
  const size = group.size.map((metres) => metres.toFixed(1)).join(" x ");
  find("about").textContent = `${group.category} ${group.name} · ${speed.toFixed(1)} m/s · ${size} m`;
  find("step").textContent = `- remove: {track: "${group.name.slice(0, 8)}"}`;
}

function followCopy() {
  find("copy").addEventListener("click", () => {
    const step = find("step");
    getSelection().selectAllChildren(step); // where the page may not write to the clipboard, the user copies it
    navigator.clipboard?.writeText(step.textContent).catch(() => {});
  });
}
