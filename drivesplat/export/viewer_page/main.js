// Opens the page: unpacks the arrays, then draws whenever the view or the window has changed.

const HINT = "Drag: look · right drag: orbit · shift drag: pan · wheel or W A S D Q E: move · R: back to the start";

// The arrays by name from zlib-compressed base64, one after the other in little-endian order (that of WebGL machines).
async function unpacked(text, layout) {
  const packed = atob(text);
  const bytes = new Uint8Array(packed.length);
  for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const kinds = { float32: Float32Array, float16: Uint16Array, uint8: Uint8Array, int8: Int8Array };
  return Object.fromEntries(layout.map(({ name, dtype, offset, length }) =>
    [name, new kinds[dtype](buffer, offset, length)]));
}

async function openPage() {
  const text = (id) => document.getElementById(id).textContent;
  const scene = JSON.parse(text("scene"));
  const arrays = await unpacked(text("payload"), scene.arrays);
  document.getElementById("payload").remove(); // no longer needed, megabytes
  const canvas = document.querySelector("canvas");
  const draw = painter(canvas, scene, arrays);
  let [view, waiting] = [null, false];
  const redraw = () => {
    if (waiting || !view) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      draw(view);
      document.documentElement.dataset.shown = "yes";
    });
  };
  const fit = () => {
    const sharpness = Math.min(devicePixelRatio, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * sharpness));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * sharpness));
    redraw();
  };
  canvas.addEventListener("webglcontextlost", () => tell("The browser lost access to the GPU: reload the page."));
  addEventListener("resize", fit);
  followInput(canvas, scene.start, (next) => { view = next; redraw(); });
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
