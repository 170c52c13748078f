// Which Gaussians are drawn, and in which order: those ahead of the camera, far to near by their depth.

// Returns order(axis, position, poses): a Uint32Array of indices that is overwritten by the next call. `centers` (3 n)
// metres in the frames of their groups, which hold `counts` Gaussians each; `poses` has null for a group not shown.
function depthOrder(centers, counts, near) {
  const count = centers.length / 3;
  const depths = new Float32Array(count);
  const keys = new Uint32Array(depths.buffer); // positive floats sort as their bits do
  const [ahead, partly, sorted] = [new Uint32Array(count), new Uint32Array(count), new Uint32Array(count)];
  const low = (i) => 0xffff - (keys[i] & 0xffff);
  const high = (i) => 0xffff - (keys[i] >>> 16);
  return (axis, position, poses) => {
    let [shown, first] = [0, 0];
    counts.forEach((length, group) => {
      const [begin, end, pose] = [first, first + length, poses[group]];
      first = end;
      if (!pose) return;
      const [ax, ay, az] = [0, 1, 2].map((j) => axis[0] * pose[j] + axis[1] * pose[4 + j] + axis[2] * pose[8 + j]);
      const offset = dot(axis, [pose[3] - position[0], pose[7] - position[1], pose[11] - position[2]]);
      for (let i = begin, j = 3 * begin; i < end; i++, j += 3) {
        depths[i] = ax * centers[j] + ay * centers[j + 1] + az * centers[j + 2] + offset;
        if (depths[i] > near) ahead[shown++] = i;
      }
    });
    radixPass(ahead, partly, shown, low);
    radixPass(partly, sorted, shown, high);
    return sorted.subarray(0, shown);
  };
}

// One pass of a radix sort: the first `count` of `from` into `to` by digit (16 bits), stable.
function radixPass(from, to, count, digit) {
  const starts = new Uint32Array(65537);
  for (let i = 0; i < count; i++) starts[digit(from[i]) + 1]++;
  for (let d = 0; d < 65536; d++) starts[d + 1] += starts[d];
  for (let i = 0; i < count; i++) to[starts[digit(from[i])]++] = from[i];
}
