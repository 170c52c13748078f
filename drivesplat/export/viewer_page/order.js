// Which rows are drawn, and in which order: those ahead of the camera, far to near by their depth.

// Returns order(axis, position, ranges): a Uint32Array of rows that is overwritten by the next call. `centers` (3 n)
// metres in the frames of their groups; a range (drives.js) has with `pose` the pose of its instance, null if it is not
// shown.
function depthOrder(centers, near) {
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
    ranges.forEach(({ begin, end, row, pose }) => {
      if (!pose) return;
      const [ax, ay, az] = [0, 1, 2].map((j) => axis[0] * pose[j] + axis[1] * pose[4 + j] + axis[2] * pose[8 + j]);
      const offset = dot(axis, [pose[3] - position[0], pose[7] - position[1], pose[11] - position[2]]);
      for (let i = row, j = 3 * begin; j < 3 * end; i++, j += 3) {
        depths[i] = ax * centers[j] + ay * centers[j + 1] + az * centers[j + 2] + offset;
        if (depths[i] > near) ahead[shown++] = i;
      }
    });
    radixPass(ahead, partly, shown, low, starts);
    radixPass(partly, sorted, shown, high, starts);
    return sorted.subarray(0, shown);
  };
}

// One pass of a radix sort: the first `count` of `from` into `to` by digit (16 bits), stable. `starts` is scratch.
function radixPass(from, to, count, digit, starts) {
  starts.fill(0);
  for (let i = 0; i < count; i++) starts[digit(from[i]) + 1]++;
  for (let d = 0; d < 65536; d++) starts[d + 1] += starts[d];
  for (let i = 0; i < count; i++) to[starts[digit(from[i])]++] = from[i];
}
