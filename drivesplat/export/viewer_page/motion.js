// Where the instances and the camera of a drive are at a second, and how instances deform. Poses are 12 values: three
// rows of [rotation | place].

// The row of `width` values between two samples, interpolated entry by entry: samples are dense enough for a
// millimetre.
function rowBetween(seconds, values, width, [first, last], second) {
  let [low, high] = [first, last - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (seconds[middle] <= second) low = middle;
    else high = middle;
  }
  const length = seconds[high] - seconds[low];
  const share = length > 0 ? Math.min(Math.max((second - seconds[low]) / length, 0), 1) : 0;
  const row = new Float32Array(width);
  for (let i = 0; i < width; i++) row[i] = (1 - share) * values[width * low + i] + share * values[width * high + i];
  return row;
}

function poseBetween(seconds, poses, samples, second) {
  return rowBetween(seconds, poses, 12, samples, second);
}

const STANDING = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]);

function isPresent(instance, second) {
  return !instance.present || instance.present.some(([first, last]) => first <= second && second <= last);
}

// The pose of an instance at a second, without its scale; null while it is absent.
function instancePose({ samples, present }, arrays, second) {
  if (!samples) return STANDING;
  if (!isPresent({ present }, second)) return null;
  return poseBetween(arrays.motion_seconds, arrays.motion_poses, samples, second);
}

// The weights of an instance's modes at a second; null for a rigid one.
function instanceWeights({ samples, modes }, arrays, count, second) {
  if (modes === null || !samples || samples[0] === samples[1]) return null;
  return rowBetween(arrays.motion_seconds, arrays.motion_weights, count, samples, second);
}

// The same pose for its Gaussians, which grow with `scale` about their origin.
function scaledPose(pose, scale) {
  return scale === 1 || !pose ? pose : pose.map((x, i) => (i % 4 === 3 ? x : scale * x));
}

// Metres per second of a moving instance at a second.
function instanceSpeed({ samples }, arrays, second) {
  const step = 0.05;
  const [before, after] = [second - step, second + step].map((at) =>
    poseBetween(arrays.motion_seconds, arrays.motion_poses, samples, at));
  const [first, last] = samples.map((row) => arrays.motion_seconds[Math.min(row, samples[1] - 1)]);
  const passed = Math.min(second + step, last) - Math.max(second - step, first);
  const way = Math.hypot(...[3, 7, 11].map((i) => after[i] - before[i]));
  return passed > 0 ? way / passed : 0;
}

// The camera of a drive as a view, by the rows of its path; `view` holds heading, pitch, roll and position.
function cameraView(arrays, rows, second) {
  const pose = poseBetween(arrays.camera_seconds, arrays.camera_poses, rows, second);
  const lines = [0, 4, 8].map((i) => Array.from(pose.subarray(i, i + 4)));
  return { ...anglesOf(lines.map((line) => line.slice(0, 3))), position: lines.map((line) => line[3]) };
}

// The moving instance whose box, at its pose, a ray from `origin` along `direction` (world) meets first; null if none.
// `poses` has null for those that are not shown.
function pickedInstance(instances, poses, origin, direction) {
  let [nearest, found] = [Infinity, null];
  instances.forEach((instance, number) => {
    const pose = instance.samples && instance.size ? poses[number] : null;
    if (!pose) return;
    let [enter, leave] = [0, Infinity];
    for (let axis = 0; axis < 3; axis++) {
      let [from, along] = [0, 0]; // origin and direction along the box's axis
      for (let row = 0; row < 3; row++) {
        from += pose[4 * row + axis] * (origin[row] - pose[4 * row + 3]);
        along += pose[4 * row + axis] * direction[row];
      }
      const ends = [-instance.size[axis] / 2, instance.size[axis] / 2].map((end) => (end - from) / along);
      enter = Math.max(enter, Math.min(...ends));
      leave = Math.min(leave, Math.max(...ends));
    }
    if (enter < leave && enter < nearest) [nearest, found] = [enter, instance];
  });
  return found;
}
