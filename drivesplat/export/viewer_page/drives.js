// The drive as recorded and as edits change it: the instances of rigid groups that there are, and the camera's path.

// The instances of a drive; `edit` is null for the recorded one. An instance has the Gaussians of the group with the
// number `group`, scaled by `scale`; id, category and size; the intervals `present` and the rows `samples` of its
// motion, null if it is static; `colors` is the matrix of its colours, row by row, null as trained.
function instancesOf(groups, edit) {
  const recorded = groups.map((group, number) => ({ ...group, id: group.name, group: number, scale: 1, colors: null }));
  if (!edit) return recorded;
  const moving = edit.instances.map((instance) => ({ ...recorded[instance.group], ...instance }));
  return [...recorded.filter((instance) => !instance.samples), ...moving];
}

// The rows of the camera's path of a drive.
function cameraRows(scene, edit) {
  return (edit && edit.camera) || scene.camera;
}

// The first Gaussian of each group, and one beyond the last of all.
function firstGaussians(groups) {
  const firsts = [0];
  groups.forEach((group) => firsts.push(firsts[firsts.length - 1] + group.gaussians));
  return firsts;
}

// Rows that are drawn, instance after instance: copies of the Gaussians `begin` to `end` from `row` on.
function rowRanges(groups, instances) {
  const firsts = firstGaussians(groups);
  let row = 0;
  return instances.map(({ group }) => {
    const range = { begin: firsts[group], end: firsts[group + 1], row };
    row += range.end - range.begin;
    return range;
  });
}

// The shortest beginning of an id, of eight letters or more, that no other id has.
function shortId(id, ids) {
  const unique = (length) => ids.filter((other) => other.startsWith(id.slice(0, length))).length === 1;
  let length = 8;
  while (length < id.length && !unique(length)) length++;
  return id.slice(0, length);
}
