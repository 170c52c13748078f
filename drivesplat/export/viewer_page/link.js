// What is seen, in the page's address: the page of another method opens with the same camera at the same time.

function fragmentOf({ view, second, following, edit, look, boxes }) {
  const numbers = [view.heading, view.pitch, view.roll, ...view.position].map((x) => x.toFixed(6));
  const words = new URLSearchParams({ second: second.toFixed(4), view: numbers.join(",") });
  if (following) words.set("following", "yes");
  if (edit) words.set("edit", edit.name);
  if (look && look !== LOOKS[0]) words.set("look", look);
  if (boxes) words.set("boxes", "yes");
  return `#${words}`;
}

// The part of the state that an address gives; what it does not give, or not as numbers, is left out. An address with a
// view follows the camera only if it says so.
function stateIn(fragment, edits) {
  const words = new URLSearchParams(fragment.replace(/^#/, ""));
  const state = {};
  const second = Number.parseFloat(words.get("second"));
  if (Number.isFinite(second)) state.second = second;
  const view = (words.get("view") || "").split(",").map(Number);
  if (view.length === 6 && view.every(Number.isFinite)) {
    state.view = { heading: view[0], pitch: view[1], roll: view[2], position: view.slice(3) };
    state.following = false;
  }
  if (words.get("following") === "yes") state.following = true;
  if (LOOKS.includes(words.get("look"))) state.look = words.get("look");
  if (words.get("boxes") === "yes") state.boxes = true;
  const edit = edits.find(({ name }) => name === words.get("edit"));
  if (edit) state.edit = edit;
  return state;
}

// The page of another method; null where this page is not in its method's folder, as in a report.
function pageBeside(path, method, other) {
  if (!decodeURIComponent(path).endsWith(`/${method}/viewer.html`)) return null;
  return `../${encodeURIComponent(other)}/viewer.html`;
}
