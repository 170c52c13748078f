// Lines over the picture, on a canvas of their own: boxes with their names, and the camera on its path.

const FRUSTUM_METRES = 1.5;
const NAME_PIXELS = 12;
const [NAME_NEAR, NAME_FAR] = [0.5, 80]; // metres ahead of the camera
const BOX_EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
const FRUSTUM_EDGES = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]];

function placed(pose, [x, y, z]) {
  return [0, 4, 8].map((i) => pose[i] * x + pose[i + 1] * y + pose[i + 2] * z + pose[i + 3]);
}

function boxCorners(pose, size) {
  const signs = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => [i & 4, i & 2, i & 1].map((bit) => (bit ? 0.5 : -0.5)));
  return signs.map((sign) => placed(pose, sign.map((s, axis) => s * size[axis])));
}

// The camera's place, and the corners of its image FRUSTUM_METRES ahead.
function frustumCorners(pose, { K, width, height }) {
  const corners = [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) =>
    [(u - K[0][2]) / K[0][0], (v - K[1][2]) / K[1][1], 1].map((x) => FRUSTUM_METRES * x));
  return [[0, 0, 0], ...corners].map((corner) => placed(pose, corner));
}

// Returns draw(view, segments, names): pairs of points in the world with a colour, cut off at the near plane; and names
// above points, from near to far, unless nearer ones are in their place.
function linePainter(canvas, frame) {
  const context = canvas.getContext("2d");
  return (view, segments, names) => {
    context.clearRect(0, 0, canvas.width, canvas.height);
    const [rotation, { focal, center }] = [rotationOf(view), pinhole(frame, canvas.width, canvas.height)];
    const inCamera = (point) => {
      const away = point.map((x, i) => x - view.position[i]);
      return [0, 1, 2].map((column) => away.reduce((sum, x, row) => sum + rotation[row][column] * x, 0));
    };
    const pixel = ([x, y, z]) => [(focal[0] * x) / z + center[0], (focal[1] * y) / z + center[1]];
    context.lineWidth = Math.max(1, canvas.height / 500);
    for (const [from, to, color] of segments) {
      const ends = cutOff(inCamera(from), inCamera(to));
      if (!ends) continue;
      context.strokeStyle = color;
      context.beginPath();
      context.moveTo(...pixel(ends[0]));
      context.lineTo(...pixel(ends[1]));
      context.stroke();
    }
    writeNames(context, names.map((one) => ({ ...one, place: inCamera(one.point) })), pixel);
  };
}

function writeNames(context, names, pixel) {
  const sharpness = context.canvas.width / Math.max(1, context.canvas.clientWidth);
  const height = NAME_PIXELS * sharpness;
  context.font = `600 ${height}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.lineWidth = 3 * sharpness;
  context.strokeStyle = "#000c";
  const taken = [];
  const ahead = names.filter(({ place }) => place[2] > NAME_NEAR && place[2] < NAME_FAR);
  for (const { name, place, color } of ahead.sort((a, b) => a.place[2] - b.place[2])) {
    const [[x, y], half] = [pixel(place), context.measureText(name).width / 2];
    const own = [x - half, x + half, y - height, y];
    if (taken.some((t) => own[0] < t[1] && t[0] < own[1] && own[2] < t[3] && t[2] < own[3])) continue;
    taken.push(own);
    context.fillStyle = color;
    context.strokeText(name, x, y - 4 * sharpness);
    context.fillText(name, x, y - 4 * sharpness);
  }
}

// The part of a line that lies ahead of the near plane; null if none does.
function cutOff(from, to) {
  const near = 0.1;
  if (from[2] < near && to[2] < near) return null;
  const share = (near - from[2]) / (to[2] - from[2]);
  const cut = from.map((x, i) => x + share * (to[i] - x));
  return [from[2] < near ? cut : from, to[2] < near ? cut : to];
}

// The lines of a second: `boxes` (boxes.js), and with `path` the path of the camera, by its rows, with the camera on
// it.
function linesAt({ frame }, arrays, boxes, rows, { second, path }) {
  const segments = [];
  const add = (points, edges, color) => edges.forEach(([a, b]) => segments.push([points[a], points[b], color]));
  boxes.forEach(({ pose, size, modelled }) => add(boxCorners(pose, size), BOX_EDGES, boxColor(modelled)));
  if (!path) return segments;
  const places = [];
  for (let i = rows[0]; i < rows[1]; i++) places.push([3, 7, 11].map((j) => arrays.camera_poses[12 * i + j]));
  places.slice(1).forEach((place, i) => segments.push([places[i], place, "#06d6a0"]));
  const pose = poseBetween(arrays.camera_seconds, arrays.camera_poses, rows, second);
  add(frustumCorners(pose, frame), FRUSTUM_EDGES, "#06d6a0");
  return segments;
}
