// Opens the page: unpacks the arrays, then draws whenever the view, the time or the window has changed.

const HINT = "Drag: look · right drag: orbit · shift drag: pan · wheel or W A S D Q E: move · R: back to the start · " +
  "space: play · click: pick an object";

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

async function openPage() {
  const text = (id) => document.getElementById(id).textContent;
  const scene = JSON.parse(text("scene"));
  const arrays = await unpacked(text("payload"), scene.arrays);
  document.getElementById("payload").remove(); // no longer needed, megabytes
  const [canvas, over] = [document.getElementById("splat"), document.getElementById("lines")];
  const [draw, drawLines] = [painter(canvas, scene, arrays), linePainter(over, scene.start)];
  const span = [arrays.camera_seconds[0], arrays.camera_seconds[arrays.camera_seconds.length - 1]];
  const state = {
    view: startView(scene.start), second: scene.start.second, playing: false, speed: 1, following: false,
    sky: scene.has_sky, boxes: false, path: false, hidden: new Set(),
  };
  const poses = () => scene.groups.map((group, number) =>
    state.hidden.has(number) ? null : groupPose(group, arrays, state.second));
  let [waiting, before] = [false, null];
  const redraw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame((now) => {
      waiting = false;
      advance(now);
      if (state.following) setView(recordedView(arrays, state.second), true);
      const groupPoses = poses();
      draw(state.view, groupPoses, state.sky);
      drawLines(state.view, linesAt(scene, arrays, groupPoses, state.second, state));
      update();
      document.documentElement.dataset.shown = "yes";
      if (state.playing) redraw();
    });
  };
  const advance = (now) => {
    if (state.playing && before !== null) {
      const next = state.second + ((now - before) / 1000) * state.speed;
      state.second = next > span[1] ? span[0] : next;
    }
    before = state.playing ? now : null;
  };
  const change = (part) => { Object.assign(state, part); redraw(); };
  const update = timeBar(state, span, scene.key_frames, change);
  shownList(state, scene.groups, scene.has_sky, change);
  followCopy();
  const pick = (x, y) => {
    const ray = rayAt(state.view, pinhole(scene.start, canvas.clientWidth, canvas.clientHeight), x, y);
    const number = pickedGroup(scene.groups, arrays, state.second, state.hidden, state.view.position, ray);
    const group = number === null ? null : scene.groups[number];
    showPicked(group, group && groupSpeed(group, arrays, state.second));
  };
  let followed = false;
  const set = followInput(canvas, scene.start, (view) => {
    change(followed ? { view } : { view, following: false }); // the user's hand ends the ride
  }, pick);
  const setView = (view, asRecorded) => { followed = asRecorded; set(view); followed = false; };
  const fit = () => {
    const sharpness = Math.min(devicePixelRatio, 2);
    for (const layer of [canvas, over]) {
      layer.width = Math.max(1, Math.round(layer.clientWidth * sharpness));
      layer.height = Math.max(1, Math.round(layer.clientHeight * sharpness));
    }
    redraw();
  };
  canvas.addEventListener("webglcontextlost", () => tell("The browser lost access to the GPU: reload the page."));
  addEventListener("resize", fit);
  fit();
  tell(HINT);
}

function tell(sentence) {
  document.getElementById("hint").textContent = sentence;
}

openPage().catch((error) => {
  tell(`This splat cannot be shown: ${error.message}`);
  console.error(error);
});
