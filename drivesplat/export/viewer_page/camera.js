// The camera under the mouse. World: metres, z up. Camera: OpenCV (x right, y down, z forward), never rolled by hand.

const ORBIT_METRES = 10; // the point that an orbit goes around lies so far ahead
const WHEEL_METRES = 0.01; // a pixel of the wheel's travel
const WALK_METRES = 0.004; // a millisecond of a key held down
const CLICK_PIXELS = 4; // a pointer that moves less between press and release has clicked
const STEEPEST = 1.5; // radians: short of straight up and down, where there is no heading

const MOVES = {
  KeyW: [0, 0, 1], ArrowUp: [0, 0, 1], KeyS: [0, 0, -1], ArrowDown: [0, 0, -1],
  KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0], KeyD: [1, 0, 0], ArrowRight: [1, 0, 0],
  KeyE: [0, -1, 0], KeyQ: [0, 1, 0],
};

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// A point or direction moved along the columns of the pose: camera to world, without the position.
function toWorld(rotation, [x, y, z]) {
  return rotation.map((row) => dot(row, [x, y, z]));
}

// The rotation, three rows, of a camera that looks along heading and pitch (radians; up is positive) with roll.
function rotationOf({ heading, pitch, roll }) {
  const [ch, sh, cp, sp] = [Math.cos(heading), Math.sin(heading), Math.cos(pitch), Math.sin(pitch)];
  const [forward, right, down] = [[ch * cp, sh * cp, sp], [sh, -ch, 0], [ch * sp, sh * sp, -cp]];
  const [cr, sr] = [Math.cos(roll), Math.sin(roll)];
  return forward.map((f, i) => [cr * right[i] + sr * down[i], cr * down[i] - sr * right[i], f]);
}

// Heading, pitch and roll of a recorded pose: its roll of a degree or less is kept, so that the first view is exact.
function anglesOf(rotation) {
  const [heading, pitch] = [Math.atan2(rotation[1][2], rotation[0][2]), Math.asin(rotation[2][2])];
  const level = rotationOf({ heading, pitch, roll: 0 });
  const along = (column) => level.reduce((sum, row, i) => sum + row[column] * rotation[i][0], 0);
  return { heading, pitch, roll: Math.atan2(along(1), along(0)) };
}

function startView(start) {
  const rows = start.camera_to_world;
  return { ...anglesOf(rows.map((row) => row.slice(0, 3))), position: rows.slice(0, 3).map((row) => row[3]) };
}

// The whole recorded frame in a canvas of any shape: focal lengths and principal point in the canvas's pixels.
function pinhole(start, width, height) {
  const scale = Math.min(width / start.width, height / start.height);
  const [[fx, , cx], [, fy, cy]] = start.K;
  const center = [width / 2 + (cx - start.width / 2) * scale, height / 2 + (cy - start.height / 2) * scale];
  return { focal: [fx * scale, fy * scale], center };
}

function turned(view, heading, pitch) {
  const level = Math.max(-STEEPEST, Math.min(STEEPEST, view.pitch + pitch));
  return { ...view, heading: view.heading + heading, pitch: level };
}

function moved(view, step) {
  const along = toWorld(rotationOf(view), step);
  return { ...view, position: view.position.map((x, i) => x + along[i]) };
}

function orbited(view, heading, pitch) {
  return moved(turned(moved(view, [0, 0, ORBIT_METRES]), heading, pitch), [0, 0, -ORBIT_METRES]);
}

// The direction in the world of a point of the canvas, in its pixels.
function rayAt(view, { focal, center }, x, y) {
  return toWorld(rotationOf(view), [(x - center[0]) / focal[0], (y - center[1]) / focal[1], 1]);
}

// Calls show(view) whenever mouse, fingers or keys have changed the view, and pick(x, y) for a click without a drag.
// Returns a function that sets the view.
function followInput(canvas, start, show, pick) {
  let view = startView(start);
  const change = (next) => show((view = next));
  let drag = null;
  canvas.addEventListener("pointerdown", (e) => (drag = { x: e.clientX, y: e.clientY, button: e.button, way: 0 }));
  addEventListener("pointerup", (e) => {
    if (drag && drag.button === 0 && drag.way < CLICK_PIXELS) pick(e.clientX, e.clientY);
    drag = null;
  });
  addEventListener("pointercancel", () => (drag = null));
  addEventListener("pointermove", (e) => {
    if (!drag) return;
    const [dx, dy] = [e.clientX - drag.x, e.clientY - drag.y];
    drag = { ...drag, x: e.clientX, y: e.clientY, way: drag.way + Math.abs(dx) + Math.abs(dy) };
    const focal = pinhole(start, canvas.clientWidth, canvas.clientHeight).focal[0];
    if (drag.button === 2) change(orbited(view, -dx / focal, -dy / focal));
    else if (drag.button === 1 || e.shiftKey) change(moved(view, [-dx, -dy, 0].map((d) => (d * ORBIT_METRES) / focal)));
    else change(turned(view, dx / focal, dy / focal));
  });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    const pixels = e.deltaY * (e.deltaMode === 1 ? 30 : 1);
    change(moved(view, [0, 0, -pixels * WHEEL_METRES]));
  }, { passive: false });
  followKeys((step) => change(moved(view, step)), () => change(startView(start)));
  change(view);
  return change;
}

// Walks while keys are held, at one speed whatever the frame rate.
function followKeys(walk, restart) {
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
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.matches("input, select, button")) return;
    if (e.code === "KeyR") restart();
    if (!(e.code in MOVES)) return;
    e.preventDefault();
    if (!held.size) requestAnimationFrame((now) => { last = now; step(now); });
    held.add(e.code);
  });
  addEventListener("keyup", (e) => held.delete(e.code));
  addEventListener("blur", () => held.clear());
}
