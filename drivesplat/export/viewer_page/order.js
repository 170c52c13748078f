// Which rows are drawn, and in which order: those ahead of the camera, far to near by their depth.

// Returns order(axis, position, ranges): a Uint32Array of rows that is overwritten by the next call. Of the shapes,
// `centers` (3 n) are metres in the frames of their groups, and `modes` what `addShifts` takes; a range (drives.js) has
// with `pose` the pose of its instance, null if it is not shown, and with `weights` those of its modes, null if rigid.
function depthOrder({ centers, modes, largest }, near) {
  let [count, depths, keys, ahead, partly, sorted] = [0];
  const starts = new Uint32Array(65537);
  const low = (i) => 0xffff - (keys[i] & 0xffff);
  const high = (i) => 0xffff - (keys[i] >>> 16);
  return (axis, position, ranges) => {
    const rows = ranges.reduce((sum, { begin, end }) => sum + end - begin, 0);
    if (rows > count || !sorted) {
      count = rows;
      depths = new Float32Array(count);
      keys = new Uint32Array(depths.buffer); // positive floats sort as their bits do
      [ahead, partly, sorted] = [new Uint32Array(count), new Uint32Array(count), new Uint32Array(count)];
    }
    let shown = 0;
    ranges.forEach(({ begin, end, row, pose, modes: first, weights }) => {
      if (!pose) return;
      const [ax, ay, az] = [0, 1, 2].map((j) => axis[0] * pose[j] + axis[1] * pose[4 + j] + axis[2] * pose[8 + j]);
      const offset = dot(axis, [pose[3] - position[0], pose[7] - position[1], pose[11] - position[2]]);
      for (let i = row, j = 3 * begin; j < 3 * end; i++, j += 3) {
        depths[i] = ax * centers[j] + ay * centers[j + 1] + az * centers[j + 2] + offset;
      }
      const after = row + end - begin;
      if (weights) {
        addShifts(depths.subarray(row, after), [ax, ay, az], modes, 6 * weights.length * first, weights, largest);
      }
      for (let i = row; i < after; i++) if (depths[i] > near) ahead[shown++] = i;
    });
    radixPass(ahead, partly, shown, low, starts);
    radixPass(partly, sorted, shown, high, starts);
    return sorted.subarray(0, shown);
  };
}

// Adds to depths how far the weighted modes shift each Gaussian along an axis of its group. A mode is six bytes, the
// shift and the turn, from `start` on, Gaussian after Gaussian; t = byte / 127 stands for largest t |t|.
function addShifts(depths, axis, modes, start, weights, largest) {
  let j = start;
  for (let i = 0; i < depths.length; i++) {
    for (let mode = 0; mode < weights.length; mode++, j += 6) {
      const unit = (weights[mode] * largest) / (127 * 127);
      for (let k = 0; k < 3; k++) depths[i] += unit * axis[k] * modes[j + k] * Math.abs(modes[j + k]);
    }
  }
}

// One pass of a radix sort: the first `count` of `from` into `to` by digit (16 bits), stable. `starts` is scratch.
function radixPass(from, to, count, digit, starts) {
  starts.fill(0);
  for (let i = 0; i < count; i++) starts[digit(from[i]) + 1]++;
  for (let d = 0; d < 65536; d++) starts[d + 1] += starts[d];
  for (let i = 0; i < count; i++) to[starts[digit(from[i])]++] = from[i];
}
