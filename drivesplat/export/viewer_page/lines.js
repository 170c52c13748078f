// Lines over the picture, on a canvas of their own: the boxes of the objects, the recorded path and its camera.

const FRUSTUM_METRES = 1.5;
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

// Returns draw(view, segments): pairs of points in the world with a colour, cut off at the near plane.
function linePainter(canvas, start) {
  const context = canvas.getContext("2d");
  return (view, segments) => {
    context.clearRect(0, 0, canvas.width, canvas.height);
    const [rotation, { focal, center }] = [rotationOf(view), pinhole(start, canvas.width, canvas.height)];
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
  };
}

// The part of a line that lies ahead of the near plane; null if none does.
function cutOff(from, to) {
  const near = 0.1;
  if (from[2] < near && to[2] < near) return null;
  const share = (near - from[2]) / (to[2] - from[2]);
  const cut = from.map((x, i) => x + share * (to[i] - x));
  return [from[2] < near ? cut : from, to[2] < near ? cut : to];
}

// The lines of a second: boxes of the shown instances, and the path of the camera, by its rows, with the camera on it.
function linesAt(scene, arrays, instances, poses, rows, second, { boxes, path }) {
  const segments = [];
  const add = (points, edges, color) => edges.forEach(([a, b]) => segments.push([points[a], points[b], color]));
  if (boxes) {
    instances.forEach(({ size }, number) => {
      if (size && poses[number]) add(boxCorners(poses[number], size), BOX_EDGES, "#ffd166");
    });
  }
  if (path) {
    const places = [];
    for (let i = rows[0]; i < rows[1]; i++) places.push([3, 7, 11].map((j) => arrays.camera_poses[12 * i + j]));
    places.slice(1).forEach((place, i) => segments.push([places[i], place, "#06d6a0"]));
    const pose = poseBetween(arrays.camera_seconds, arrays.camera_poses, rows, second);
    add(frustumCorners(pose, scene.start), FRUSTUM_EDGES, "#06d6a0");
  }
  return segments;
}
