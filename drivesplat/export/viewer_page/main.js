// Opens the page: unpacks the arrays, and connects the controls with what is shown.

// The arrays by name from zlib-compressed base64, one after the other in little-endian order (that of WebGL machines).
async function unpacked(text, layout) {
  const packed = atob(text);
  const bytes = new Uint8Array(packed.length);
  for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const kinds = {
    float32: Float32Array, float16: Uint16Array, uint16: Uint16Array, uint8: Uint8Array, int8: Int8Array,
  };
  return Object.fromEntries(layout.map(({ name, dtype, offset, length }) =>
    [name, new kinds[dtype](buffer, offset, length)]));
}

// The drive from its beginning, with its camera, unless the address says something else.
function openingState(scene, arrays) {
  const second = arrays.camera_seconds[scene.camera[0]];
  return {
    view: cameraView(arrays, scene.camera, second), second, playing: false, speed: 1, following: true, look: LOOKS[0],
    sky: scene.has_sky, boxes: false, path: false, figures: false, hidden: new Set(), edit: null, image: "none",
    opacity: 0.5, ...stateIn(location.hash, scene.edits),
  };
}

async function openPage() {
  const text = (id) => document.getElementById(id).textContent;
  const scene = JSON.parse(text("scene"));
  const arrays = await unpacked(text("payload"), scene.arrays);
  document.getElementById("payload").remove(); // no longer needed, megabytes
  const layers = [find("splat"), find("lines")];
  const paint = painter(layers[0], scene, arrays);
  const state = openingState(scene, arrays);
  if (!paint.looks.includes(state.look)) state.look = LOOKS[0];
  let shown = null; // what draws, once the controls are there
  const change = (part) => {
    if (part.playing) find("hint").hidden = true;
    Object.assign(state, part);
    shown.redraw();
  };
  const span = [scene.camera[0], scene.camera[1] - 1].map((row) => arrays.camera_seconds[row]);
  const controls = {
    fillList: shownList(state, scene.has_sky, change),
    updates: [timeBar(state, scene, span, change), switches(state, change)],
  };
  shown = shower({ scene, arrays, layers, paint, span }, state, controls);
  lookChooser(paint.looks, state, change);
  editChooser(scene, state, change);
  imageChooser(scene, state, change);
  methodChooser(scene, state);
  followCopy();
  const hideHint = hints();
  const byHand = (view) => { hideHint(); change({ view, following: false }); }; // the user's hand ends the ride
  followInput(layers[0], scene.frame, (moved) => byHand(moved(state.view)), (x, y) => {
    const { found, ids } = shown.pickAt(x, y);
    showPicked(found, ids, found && instanceSpeed(found, arrays, state.second));
  });
  const save = () => savePicture(layers, shown.drawNow(), state.second);
  const link = () => copyLink(state);
  find("save").addEventListener("click", save);
  find("link").addEventListener("click", link);
  const next = (look) => paint.looks[(paint.looks.indexOf(look) + 1) % paint.looks.length];
  followShortcuts({
    Space: () => change({ playing: !state.playing }), KeyR: () => change({ following: true }),
    KeyV: () => change({ look: next(state.look) }), KeyB: () => change({ boxes: !state.boxes }),
    KeyF: () => change({ figures: !state.figures }), KeyP: save, KeyL: link,
  });
  addEventListener("hashchange", () => location.reload()); // a link to another view of this page
  shown.redraw();
}

openPage().catch((error) => {
  tell(`This splat cannot be shown: ${error.message}`);
  console.error(error);
});
