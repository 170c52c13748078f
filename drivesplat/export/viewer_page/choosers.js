// Lists to choose from: what the picture shows, an edit of the scene, where the recorded image is shown, and the page
// of another method.

// Fills a list with [text, value] and shows it; calls choose(value) for each choice.
function chooser(id, options, chosen, choose) {
  const list = find(id);
  list.append(...options.map(([text, value]) => element("option", text, { value })));
  list.value = chosen;
  list.hidden = false;
  list.addEventListener("change", () => choose(list.value));
}

function lookChooser(looks, state, change) {
  chooser("look", looks.map((look) => [look, look]), state.look, (look) => change({ look }));
}

function editChooser(scene, state, change) {
  if (!scene.edits.length) return;
  const options = [["as recorded", ""], ...scene.edits.map(({ name }, number) => [`edit: ${name}`, `${number}`])];
  const chosen = state.edit ? `${scene.edits.indexOf(state.edit)}` : "";
  chooser("edit", options, chosen, (number) => change({ edit: number === "" ? null : scene.edits[number] }));
}

// Choosing where the image is shown also goes to where there is one: to the nearest key frame on the camera's path.
function imageChooser(scene, state, change) {
  if (!scene.images.length) return;
  const options = [["no image", "none"], ["image over", "over"], ["image beside", "beside"]];
  chooser("image", options, state.image, (image) => {
    const there = { playing: false, following: true, second: nearestSecond(scene.images, state.second) };
    change(image === "none" ? { image } : { image, ...there });
  });
  find("opacity").addEventListener("input", (e) => change({ opacity: Number(e.target.value) }));
}

function methodChooser(scene, state) {
  const others = scene.methods.filter((method) => method !== scene.method);
  if (!others.length || !pageBeside(location.pathname, scene.method, others[0])) return;
  const options = [scene.method, ...others].map((method) => [`method: ${method}`, method]);
  chooser("method", options, scene.method, (method) => {
    find("method").value = scene.method; // where the browser returns to this page
    location.assign(pageBeside(location.pathname, scene.method, method) + fragmentOf(state));
  });
}
