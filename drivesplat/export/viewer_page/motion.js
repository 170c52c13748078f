// Where the rigid groups and the recorded camera are at a second. Poses are 12 values: three rows of [rotation | place].

// The pose between two samples, interpolated entry by entry: samples are dense enough for a millimetre.
function poseBetween(seconds, poses, [first, last], second) {
  let [low, high] = [first, last - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (seconds[middle] <= second) low = middle;
    else high = middle;
  }
  const length = seconds[high] - seconds[low];
  const share = length > 0 ? Math.min(Math.max((second - seconds[low]) / length, 0), 1) : 0;
  const pose = new Float32Array(12);
  for (let i = 0; i < 12; i++) pose[i] = (1 - share) * poses[12 * low + i] + share * poses[12 * high + i];
  return pose;
}

const STANDING = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]);

function isPresent(group, second) {
  return !group.present || group.present.some(([first, last]) => first <= second && second <= last);
}

// The pose of a group at a second; null while it is absent.
function groupPose(group, arrays, second) {
  if (!group.samples) return STANDING;
  if (!isPresent(group, second)) return null;
  return poseBetween(arrays.motion_seconds, arrays.motion_poses, group.samples, second);
}

// Metres per second of a moving group at a second.
function groupSpeed(group, arrays, second) {
  const step = 0.05;
  const [before, after] = [second - step, second + step].map((at) =>
    poseBetween(arrays.motion_seconds, arrays.motion_poses, group.samples, at));
  const [first, last] = group.samples.map((row) => arrays.motion_seconds[Math.min(row, group.samples[1] - 1)]);
  const passed = Math.min(second + step, last) - Math.max(second - step, first);
  const way = Math.hypot(...[3, 7, 11].map((i) => after[i] - before[i]));
  return passed > 0 ? way / passed : 0;
}

// The recorded camera as a view; `view` holds heading, pitch, roll and position.
function recordedView(arrays, second) {
  const pose = poseBetween(arrays.camera_seconds, arrays.camera_poses, [0, arrays.camera_seconds.length], second);
  const rows = [0, 4, 8].map((i) => Array.from(pose.subarray(i, i + 4)));
  return { ...anglesOf(rows.map((row) => row.slice(0, 3))), position: rows.map((row) => row[3]) };
}

// The moving group whose box a ray from `origin` along `direction` (world) meets first at a second; null if none.
function pickedGroup(groups, arrays, second, hidden, origin, direction) {
  let [nearest, found] = [Infinity, null];
  groups.forEach((group, number) => {
    const pose = group.samples && group.size && !hidden.has(number) ? groupPose(group, arrays, second) : null;
    if (!pose) return;
    let [enter, leave] = [0, Infinity];
    for (let axis = 0; axis < 3; axis++) {
      let [from, along] = [0, 0]; // origin and direction along the box's axis
      for (let row = 0; row < 3; row++) {
        from += pose[4 * row + axis] * (origin[row] - pose[4 * row + 3]);
        along += pose[4 * row + axis] * direction[row];
      }
      const ends = [-group.size[axis] / 2, group.size[axis] / 2].map((end) => (end - from) / along);
      enter = Math.max(enter, Math.min(...ends));
      leave = Math.min(leave, Math.max(...ends));
    }
    if (enter < leave && enter < nearest) [nearest, found] = [enter, number];
  });
  return found;
}
