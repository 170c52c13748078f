// What is seen, in the page's address: the page of another method opens with the same camera at the same time.

function fragmentOf({ view, second, following, edit }) {
  const numbers = [view.heading, view.pitch, view.roll, ...view.position].map((x) => x.toFixed(6));
  const words = new URLSearchParams({ second: second.toFixed(4), view: numbers.join(",") });
  if (following) words.set("following", "yes");
  if (edit) words.set("edit", edit.name);
  return `#${words}`;
}

// The part of the state that an address gives; what it does not give, or not as numbers, is left out.
function stateIn(fragment, edits) {
  const words = new URLSearchParams(fragment.replace(/^#/, ""));
  const state = {};
  const second = Number.parseFloat(words.get("second"));
  if (Number.isFinite(second)) state.second = second;
  const view = (words.get("view") || "").split(",").map(Number);
  if (view.length === 6 && view.every(Number.isFinite)) {
    state.view = { heading: view[0], pitch: view[1], roll: view[2], position: view.slice(3) };
  }
  if (words.get("following") === "yes") state.following = true;
  const edit = edits.find(({ name }) => name === words.get("edit"));
  if (edit) state.edit = edit;
  return state;
}

// The page of another method; null where this page is not in its method's folder, as in a report.
function pageBeside(path, method, other) {
  if (!decodeURIComponent(path).endsWith(`/${method}/viewer.html`)) return null;
  return `../${encodeURIComponent(other)}/viewer.html`;
}
