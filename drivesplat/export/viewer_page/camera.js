// Views and their changes. World: metres, z up. Camera: OpenCV (x right, y down, z forward), never rolled by hand.

const ORBIT_METRES = 10; // the point that an orbit goes around lies so far ahead
const STEEPEST = 1.5; // radians: short of straight up and down, where there is no heading

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

// The whole recorded frame in a canvas of any shape: focal lengths and principal point in the canvas's pixels.
function pinhole(frame, width, height) {
  const scale = Math.min(width / frame.width, height / frame.height);
  const [[fx, , cx], [, fy, cy]] = frame.K;
  const center = [width / 2 + (cx - frame.width / 2) * scale, height / 2 + (cy - frame.height / 2) * scale];
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

// What two fingers do that go from two points, `before`, to two others: a step of the camera, which moves the street at
// ORBIT_METRES along with them; apart by a factor e goes as far ahead.
function pinchStep(before, after, focal) {
  const middle = ([a, b]) => [(a.x + b.x) / 2, (a.y + b.y) / 2];
  const apart = ([a, b]) => Math.max(1, Math.hypot(a.x - b.x, a.y - b.y));
  const [from, to] = [middle(before), middle(after)];
  const pan = [0, 1].map((i) => ((from[i] - to[i]) * ORBIT_METRES) / focal);
  return [...pan, ORBIT_METRES * Math.log(apart(after) / apart(before))];
}
