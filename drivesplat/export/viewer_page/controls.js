// The controls over the picture: time, what is shown, and the object that was clicked.

const find = (id) => document.getElementById(id);

function element(kind, text, properties = {}) {
  return Object.assign(document.createElement(kind), { textContent: text, ...properties });
}

// Boxes to tick for parts of the state that are on or off. Returns update(), which shows the state.
function switches(state, change) {
  const names = { follow: "following", "boxes-on": "boxes", "figures-on": "figures" };
  for (const [id, name] of Object.entries(names)) {
    find(id).addEventListener("change", (e) => change({ [name]: e.target.checked }));
  }
  find("depths").firstChild.style.background = `linear-gradient(to right, ${DEPTH_COLORS.join(", ")})`;
  find("more").addEventListener("click", () => find("bar").classList.toggle("open"));
  return () => {
    for (const [id, name] of Object.entries(names)) find(id).checked = state[name];
    find("followed").textContent = state.edit && state.edit.camera ? "edited camera" : "recorded camera";
    find("figures").hidden = !state.figures;
    find("look").value = state.look;
    find("depths").hidden = state.look !== "depth";
  };
}

function instanceLabel({ id, samples, category }, ids) {
  return samples ? `${category || "object"} ${shortId(id, ids)}` : id;
}

// A box to tick for the path of the camera, the sky and each instance. Returns fill(instances), for another drive.
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

// What mouse, keys and fingers do: shown until the drive plays or the view is moved by hand, and again on request.
// Returns hide().
function hints() {
  const hint = find("hint");
  const fingers = matchMedia("(pointer: coarse)").matches;
  const help = fingers
    ? "One finger: look · two fingers: move and zoom · tap: pick an object"
    : "Drag: look · right drag: orbit · shift drag: pan · wheel or W A S D Q E: move · R: follow the camera again · " +
      "space: play · V: colour, depth, instances · B: boxes · F: frames a second · P: save the picture · L: link · " +
      "click: pick an object";
  tell(help);
  find("help").addEventListener("click", () => {
    if (hint.hidden || hint.textContent !== help) tell(help);
    else hint.hidden = true;
  });
  return () => (hint.hidden = true);
}

function tell(sentence) {
  Object.assign(find("hint"), { textContent: sentence, hidden: false });
}
