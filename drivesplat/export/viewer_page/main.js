// Opens the page: unpacks the arrays, then draws whenever the view, the time or the window has changed.

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

// The drive that the state names: its instances, where their rows are, and the rows of its camera's path.
function driveOf(scene, edit) {
  const instances = instancesOf(scene.groups, edit);
  return { edit, instances, ranges: rowRanges(scene.groups, instances), camera: cameraRows(scene, edit) };
}

// The ranges of a drive's instances with their poses at the state's second, null for those not shown, and the weights
// of their `count` modes; and these poses without scale.
function posed({ instances, ranges }, arrays, count, { second, hidden }) {
  const poses = instances.map((one) => (hidden.has(one.id) ? null : instancePose(one, arrays, second)));
  const shown = instances.map((one, i) => ({
    pose: scaledPose(poses[i], one.scale), colors: one.colors, modes: one.modes,
    weights: poses[i] && instanceWeights(one, arrays, count, second),
  }));
  return [ranges.map((range, i) => ({ ...range, ...shown[i] })), poses];
}

function openingState(scene) {
  return {
    view: startView(scene.start), second: scene.start.second, playing: false, speed: 1, following: false,
    sky: scene.has_sky, boxes: false, path: false, hidden: new Set(), edit: null, image: "none", opacity: 0.5,
    ...stateIn(location.hash, scene.edits),
  };
}

async function openPage() {
  const text = (id) => document.getElementById(id).textContent;
  const scene = JSON.parse(text("scene"));
  const arrays = await unpacked(text("payload"), scene.arrays);
  document.getElementById("payload").remove(); // no longer needed, megabytes
  const [canvas, over] = [document.getElementById("splat"), document.getElementById("lines")];
  const [paint, drawLines] = [painter(canvas, scene, arrays), linePainter(over, scene.start)];
  const [state, showImage] = [openingState(scene), imageLayer(scene.images, scene.start)];
  const span = [scene.camera[0], scene.camera[1] - 1].map((row) => arrays.camera_seconds[row]);
  let [drive, waiting, before] = [null, false, null];
  const redraw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame((now) => {
      waiting = false;
      advance(now);
      show();
      if (state.playing) redraw();
    });
  };
  const change = (part) => { Object.assign(state, part); redraw(); };
  const shapes = { centers: arrays.means.slice(), modes: arrays.modes, largest: scene.modes_range };
  const sorter = sorterOf(shapes, NEAR, (rows) => { paint.setOrder(rows); redraw(); });
  const fillList = shownList(state, scene.has_sky, change);
  const update = timeBar(state, span, scene.key_frames, change);
  const show = () => {
    const another = !drive || drive.edit !== state.edit;
    if (another) {
      drive = driveOf(scene, state.edit);
      fillList(drive.instances);
      showPicked(null);
    }
    if (state.following) state.view = cameraView(arrays, drive.camera, state.second);
    if (showImage(state, canvas)) fit();
    const [ranges, poses] = posed(drive, arrays, scene.modes, state);
    const seen = [rotationOf(state.view).map((row) => row[2]), state.view.position, ranges];
    if (another) {
      paint.setDrive(ranges);
      paint.setOrder(sorter.now(...seen));
    } else sorter.later(...seen);
    paint.draw(state.view, ranges, state.sky);
    drawLines(state.view, linesAt(scene, arrays, drive.instances, poses, drive.camera, state.second, state));
    update();
    document.documentElement.dataset.shown = sorter.settled() ? "yes" : "sorting";
  };
  const advance = (now) => {
    if (state.playing && before !== null) {
      const next = state.second + ((now - before) / 1000) * state.speed;
      state.second = next > span[1] ? span[0] : next;
    }
    before = state.playing ? now : null;
  };
  followCopy();
  editChooser(scene, state, change);
  imageChooser(scene, state, change);
  methodChooser(scene, state);
  const hideHint = hints();
  const byHand = (view) => { hideHint(); change({ view, following: false }); }; // the user's hand ends the ride
  const pick = (x, y) => {
    const ray = rayAt(state.view, pinhole(scene.start, canvas.clientWidth, canvas.clientHeight), x, y);
    const found = pickedInstance(drive.instances, posed(drive, arrays, scene.modes, state)[1], state.view.position, ray);
    showPicked(found, drive.instances.map(({ id }) => id), found && instanceSpeed(found, arrays, state.second));
  };
  const restart = () => byHand(startView(scene.start));
  followInput(canvas, scene.start, (moved) => byHand(moved(state.view)), restart, pick);
  const fit = () => {
    const sharpness = Math.min(devicePixelRatio, 2);
    for (const layer of [canvas, over]) {
      layer.width = Math.max(1, Math.round(layer.clientWidth * sharpness));
      layer.height = Math.max(1, Math.round(layer.clientHeight * sharpness));
    }
  };
  canvas.addEventListener("webglcontextlost", () => tell("The browser lost access to the GPU: reload the page."));
  addEventListener("resize", () => { fit(); redraw(); });
  fit();
  redraw();
}

function tell(sentence) {
  Object.assign(document.getElementById("hint"), { textContent: sentence, hidden: false });
}

openPage().catch((error) => {
  tell(`This splat cannot be shown: ${error.message}`);
  console.error(error);
});
