// The view under mouse, fingers and keys.

const WHEEL_METRES = 0.01; // a pixel of the wheel's travel
const WALK_METRES = 0.004; // a millisecond of a key held down
const CLICK_PIXELS = 6; // a pointer that moves less between press and release has clicked

const MOVES = {
  KeyW: [0, 0, 1], ArrowUp: [0, 0, 1], KeyS: [0, 0, -1], ArrowDown: [0, 0, -1],
  KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0], KeyD: [1, 0, 0], ArrowRight: [1, 0, 0],
  KeyE: [0, -1, 0], KeyQ: [0, 1, 0],
};

// Calls change(view => view) whenever mouse, fingers or keys change the view, and pick(x, y) for a click without a
// drag.
function followInput(canvas, frame, change, pick) {
  const focal = () => pinhole(frame, canvas.clientWidth, canvas.clientHeight).focal[0];
  followPointers(canvas, (before, after, drag) => {
    if (before.length > 1) return change((view) => moved(view, pinchStep(before, after, focal())));
    const [dx, dy] = [after[0].x - before[0].x, after[0].y - before[0].y].map((pixels) => pixels / focal());
    if (drag.button === 2) return change((view) => orbited(view, -dx, -dy));
    const pan = [-ORBIT_METRES * dx, -ORBIT_METRES * dy, 0];
    if (drag.button === 1 || drag.shift) return change((view) => moved(view, pan));
    return change((view) => turned(view, dx, dy));
  }, pick);
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    const pixels = e.deltaY * (e.deltaMode === 1 ? 30 : 1);
    change((view) => moved(view, [0, 0, -pixels * WHEEL_METRES]));
  }, { passive: false });
  followKeys((step) => change((view) => moved(view, step)));
}

// Calls drag(before, after, { button, shift }) with the places of the one or two pointers that are down, and pick(x, y)
// for one that was released near where it was pressed, without a drag before.
function followPointers(canvas, drag, pick) {
  const down = new Map(); // places by pointer, in the order in which they were pressed
  let [button, way] = [0, 0]; // of all since the first was pressed: the way as far as a drag begins
  canvas.addEventListener("pointerdown", (e) => {
    [button, way] = down.size ? [button, Infinity] : [e.button, 0];
    down.set(e.pointerId, { x: e.clientX, y: e.clientY });
  });
  addEventListener("pointermove", (e) => {
    if (!down.has(e.pointerId)) return;
    const before = [...down.values()].slice(0, 2);
    const from = down.get(e.pointerId);
    way = Math.max(way, Math.abs(e.clientX - from.x) + Math.abs(e.clientY - from.y));
    if (way < CLICK_PIXELS) return;
    down.set(e.pointerId, { x: e.clientX, y: e.clientY });
    drag(before, [...down.values()].slice(0, 2), { button, shift: e.shiftKey });
  });
  addEventListener("pointerup", (e) => {
    if (down.delete(e.pointerId) && button === 0 && way < CLICK_PIXELS) pick(e.clientX, e.clientY);
  });
  addEventListener("pointercancel", (e) => down.delete(e.pointerId));
}

// Walks while keys are held, at one speed whatever the frame rate.
function followKeys(walk) {
  const held = new Set();
  let last = 0;
  const step = (now) => {
    if (!held.size) return;
    const metres = Math.min(now - last, 100) * WALK_METRES;
    last = now;
    const directions = [...held].map((code) => MOVES[code]);
    walk([0, 1, 2].map((i) => metres * directions.reduce((sum, direction) => sum + direction[i], 0)));
    requestAnimationFrame(step);
  };
  addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.matches("select, input[type=range]")) return;
    if (!(e.code in MOVES)) return;
    e.preventDefault();
    if (!held.size) requestAnimationFrame((now) => { last = now; step(now); });
    held.add(e.code);
  });
  addEventListener("keyup", (e) => held.delete(e.code));
  addEventListener("blur", () => held.clear());
}
