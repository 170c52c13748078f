// Which Gaussians are drawn, and in which order: those ahead of the camera, far to near by their depth.

// Returns order(axis, position): a Uint32Array of indices that is overwritten by the next call. `centers` (3 n) metres.
function depthOrder(centers, near) {
  const count = centers.length / 3;
  const depths = new Float32Array(count);
  const keys = new Uint32Array(depths.buffer); // positive floats sort as their bits do
  const [ahead, partly, sorted] = [new Uint32Array(count), new Uint32Array(count), new Uint32Array(count)];
  const low = (i) => 0xffff - (keys[i] & 0xffff);
  const high = (i) => 0xffff - (keys[i] >>> 16);
  return ([ax, ay, az], [px, py, pz]) => {
    let shown = 0;
    for (let i = 0, j = 0; i < count; i++, j += 3) {
      depths[i] = ax * (centers[j] - px) + ay * (centers[j + 1] - py) + az * (centers[j + 2] - pz);
      if (depths[i] > near) ahead[shown++] = i;
    }
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
