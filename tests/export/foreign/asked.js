// What the viewers' pages share: the address, waiting, and the extent of what a viewer has read.

// The file, and the camera's place and a point before it, from the address.
export function asked() {
  const words = new URLSearchParams(location.search);
  const point = (name) => words.get(name).split(",").map(Number);
  return { file: words.get("file"), position: point("position"), target: point("target") };
}

// Waits until done() holds, asked for every frame.
export function frames(done) {
  return new Promise((resolve) => {
    const look = () => (done() ? resolve() : requestAnimationFrame(look));
    look();
  });
}

// The number of Gaussians, and the corners of the box around their centres.
export function extentOf(count, center) {
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  for (let i = 0; i < count; i++) {
    center(i).forEach((x, axis) => {
      low[axis] = x < low[axis] ? x : low[axis];
      high[axis] = x > high[axis] ? x : high[axis];
      if (!Number.isFinite(x)) throw new Error(`Gaussian ${i} is not at a finite place`);
    });
  }
  return { count, low, high };
}
