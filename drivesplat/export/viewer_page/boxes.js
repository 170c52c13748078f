// The boxes of all objects: those with Gaussians of their own, and those that the model shows with the background.

// The boxes of a second: `name`, `size`, `pose`, and whether the object has Gaussians of its own (`modelled`). `poses`
// are those of the drive's instances, null for those that are not shown.
function boxesAt(scene, arrays, instances, poses, second) {
  const ids = [...instances, ...scene.boxes].map(({ id }) => id);
  const found = [];
  const add = (one, pose, modelled) => {
    if (pose) found.push({ name: boxName(one, ids), size: one.size, pose, modelled });
  };
  instances.forEach((one, number) => one.samples && one.size && add(one, poses[number], true));
  scene.boxes.forEach((one) => {
    const pose = isPresent(one, second) && poseBetween(arrays.box_seconds, arrays.box_poses, one.samples, second);
    add(one, pose, false);
  });
  return found;
}

// The class without its first word, which is that of its family, and the shortened id.
function boxName({ id, category }, ids) {
  return `${(category || "object").replace(/^[^.]*\./, "")} ${shortId(id, ids)}`;
}

// A point of the world, or a direction, along the three axes of a pose, from its place.
function inObject(pose, away) {
  return [0, 1, 2].map((axis) => [0, 1, 2].reduce((sum, row) => sum + pose[4 * row + axis] * away[row], 0));
}

// The first box that a point lies in; null if none does.
function boxAround(boxes, point) {
  const inside = ({ pose, size }) => {
    const own = inObject(pose, point.map((x, row) => x - pose[4 * row + 3]));
    return own.every((x, axis) => Math.abs(x) < size[axis] / 2);
  };
  return boxes.find(inside) || null;
}

// The names of boxes with the points of the world above which they stand: the middles of the upper sides.
function boxNames(boxes) {
  return boxes.map(({ name, pose, size, modelled }) =>
    ({ name, point: placed(pose, [0, 0, size[2] / 2]), color: boxColor(modelled) }));
}

const boxColor = (modelled) => (modelled ? "#ffd166" : "#8ecae6");
