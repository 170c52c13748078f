"""Functions of viewer.html's scripts that need no browser, by Node."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from helpers.patience import PATIENCE_S
from matplotlib import colormaps
from scipy.spatial.transform import Rotation

from drivesplat.export import viewer_page

FOLDER = Path(viewer_page.__file__).parent
NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="no Node here")


def by_node(*files: str, expression: str, **values: object) -> object:
    """The value of an expression with some of the page's scripts and with `values`."""
    source = [(FOLDER / f"{name}.js").read_text(encoding="utf-8") for name in files]
    source += [f"const {name} = {json.dumps(value)};" for name, value in values.items()]
    source.append(f"Promise.resolve({expression}).then((value) => console.log(JSON.stringify(value)));")
    done = subprocess.run([str(NODE), "-"], input="\n".join(source), capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_rows_are_sorted_far_to_near_instance_by_instance():
    """Two groups, the second twice, once of double size; Gaussians behind the camera and hidden ones are left out."""
    rng = np.random.default_rng(0)
    centers = rng.uniform(-5.0, 5.0, (60, 3)).astype(np.float32)
    poses = [
        np.eye(4)[:3],
        np.hstack([2.0 * np.eye(3), [[1.0], [2.0], [3.0]]]),
        np.hstack([np.eye(3), [[4.0], [0], [0]]]),
    ]
    ranges = [(0, 40, 0, poses[0]), (40, 60, 40, poses[1]), (40, 60, 60, None), (40, 60, 80, poses[2])]
    axis, position = np.array([0.6, 0.0, 0.8]), np.array([-1.0, 0.5, -2.0])
    records = [
        {"begin": begin, "end": end, "row": row, "pose": None if pose is None else pose.ravel().tolist()}
        for begin, end, row, pose in ranges
    ]
    rows = by_node(
        "camera", "order", axis=axis.tolist(), position=position.tolist(), centers=centers.ravel().tolist(),
        ranges=records,
        expression="Array.from(depthOrder({ centers: new Float32Array(centers) }, 0.01)(axis, position, ranges))",
    )  # fmt: skip
    depths = {}
    for begin, end, row, pose in ranges:
        if pose is not None:
            depth = (centers[begin:end] @ pose[:, :3].T + pose[:, 3] - position) @ axis
            depths |= {row + i: value for i, value in enumerate(depth) if value > 0.01}
    assert 40 < len(depths) < 80
    assert sorted(rows) == sorted(depths)
    np.testing.assert_array_equal(np.diff([depths[row] for row in rows]) <= 1e-5, True)


def test_rows_of_what_deforms_are_sorted_where_their_modes_shift_them():
    """The second group of two, twice, with other weights each; the third instance is rigid."""
    rng = np.random.default_rng(1)
    centers, modes = rng.uniform(-3.0, 3.0, (30, 3)), rng.integers(-127, 128, (20, 2, 2, 3))
    pose = np.hstack([Rotation.from_euler("zyx", [0.4, -0.2, 0.1]).as_matrix(), [[1.0], [0.0], [6.0]]])
    weights = [[0.5, -1.5], [-1.0, 0.25], None]
    axis, first = np.array([0.0, 0.0, 1.0]), 8  # rows of modes of other groups
    records = [
        {"begin": 18, "end": 30, "row": 12 * i, "pose": pose.ravel().tolist(), "modes": first, "weights": own}
        for i, own in enumerate(weights)
    ]
    shapes = {"centers": centers.ravel().tolist(), "modes": modes.ravel().tolist(), "largest": 2.0}
    rows = by_node(
        "camera", "order", axis=axis.tolist(), position=[0.0, 0.0, 0.0], shapes=shapes, ranges=records,
        expression="Array.from(depthOrder(shapes, 0.01)(axis, position, ranges))",
    )  # fmt: skip
    shifts = 2.0 * modes[first:, :, 0] * np.abs(modes[first:, :, 0]) / 127.0**2  # (12, 2, 3)
    depths = np.concatenate([
        ((centers[18:] + np.einsum("k,nkj->nj", own or [0.0, 0.0], shifts)) @ pose[:, :3].T + pose[:, 3]) @ axis
        for own in weights
    ])  # fmt: skip
    assert sorted(rows) == np.flatnonzero(depths > 0.01).tolist()
    assert (np.diff(depths[rows]) <= 1e-5).all()


def test_while_the_worker_sorts_the_page_keeps_the_last_order_and_asks_for_the_newest():
    """A worker that answers when it is told to: of three further wishes made meanwhile, the last is sorted."""
    sequence = """(() => {
      const [asked, shown] = [[], []];
      const worker = { postMessage: (data) => asked.push(data) };
      globalThis.Worker = function () { return worker; };
      globalThis.URL = { createObjectURL: () => "" };
      const ranges = [{ begin: 0, end: 1, row: 0, pose: STANDING }];
      const sorter = sorterOf({ centers: new Float32Array(3) }, 0.01, (rows) => shown.push(rows));
      const wish = (x) => sorter.later([0, 0, 1], [x, 0, -1], ranges);
      sorter.now([0, 0, 1], [0, 0, -1], ranges);
      wish(0); // as it is
      wish(1); wish(2); wish(3); wish(4);
      const [before, settled] = [shown.length, [sorter.settled()]];
      worker.onmessage({ data: { number: 1, rows: "first" } });
      settled.push(sorter.settled());
      worker.onmessage({ data: { number: 2, rows: "last" } });
      settled.push(sorter.settled());
      return { before, settled, shown, asked: asked.slice(1).map(({ position }) => position[0]) };
    })()"""
    found = by_node("camera", "motion", "order", "sorter", expression=sequence)
    assert found == {"before": 0, "settled": [False, False, True], "shown": ["first", "last"], "asked": [1, 4]}


def test_an_address_brings_back_view_time_edit_and_look_and_ignores_nonsense():
    view = {"heading": 0.25, "pitch": -0.125, "roll": 0.5, "position": [1.5, -2.25, 1e3]}
    edits = [{"name": "a & b"}, {"name": "other"}]
    state = {"view": view, "second": 1.25, "following": True, "look": "depth", "boxes": True}
    nonsense = ["", "#", "#second=x&view=1,2&edit=gone&look=x-ray", "#view=1,2,3,4,5,NaN"]
    expression = """[fragmentOf({ ...state, edit: edits[0] }), ...nonsense].map((part) => stateIn(part, edits))"""
    back = by_node("looks", "link", state=state, edits=edits, nonsense=nonsense, expression=expression)
    assert back == [{**state, "edit": edits[0]}, {}, {}, {}, {}]


def test_an_address_with_a_view_alone_is_not_moved_by_the_drive():
    """As in links of pages that did not follow the camera by themselves; one with a time alone follows it."""
    links = ["#second=1.5&view=1,0,0,4,5,6", "#second=1.5&view=1,0,0,4,5,6&following=yes", "#second=1.5"]
    found = by_node("looks", "link", links=links, expression="links.map((link) => stateIn(link, []).following ?? null)")
    assert found == [False, True, None]
    plain = {"view": {"heading": 0, "pitch": 0, "roll": 0, "position": [0, 0, 0]}, "second": 0, "following": False}
    words = by_node("looks", "link", state={**plain, "look": "colour", "boxes": False}, expression="fragmentOf(state)")
    assert set(re.findall(r"(\w+)=", words)) == {"second", "view"}


def test_pages_beside_are_those_in_the_folders_of_methods():
    beside = {
        "/home/results/0061/street/viewer.html": "../gsplat%20d/viewer.html",
        "/C:/results/0061/street/viewer.html": "../gsplat%20d/viewer.html",
        "/report/data/raw/0a1b/viewer.html": None,
        "/downloads/viewer.html": None,
    }
    expression = 'paths.map((path) => pageBeside(path, "street", "gsplat d"))'
    assert by_node("looks", "link", paths=list(beside), expression=expression) == list(beside.values())


def test_an_image_is_shown_at_its_key_frame_on_the_path_of_the_camera():
    images, cases = [{"second": 0.0}, {"second": 0.5}, {"second": 1.0}], [
        ({"second": 0.5, "image": "over"}, 0.5),
        ({"second": 0.505, "image": "over"}, 0.5),
        ({"second": 0.6, "image": "over"}, None),
        ({"second": 0.5, "image": "over", "playing": True}, None),
        ({"second": 0.5, "image": "over", "following": False}, None),
        ({"second": 0.9, "image": "beside", "playing": True}, 0.5),
        ({"second": 0.5, "image": "none"}, None),
    ]  # fmt: skip
    states = [{"playing": False, "following": True, **state} for state, _ in cases]
    expression = "states.map((state) => (imageAt(images, state) || { second: null }).second)"
    assert by_node("images", images=images, states=states, expression=expression) == [second for _, second in cases]


def test_an_edit_keeps_what_is_static_and_replaces_what_moves_and_ids_are_shortened_while_unique():
    groups = [
        {"name": "background", "gaussians": 5, "samples": None, "present": None, "modes": None},
        {"name": "car", "gaussians": 3, "samples": [0, 4], "present": [[0, 1]], "category": "vehicle.car"},
    ]
    edit = {"instances": [{"id": "car", "group": 1}, {"id": "twin", "group": 1, "scale": 2, "samples": [4, 9]}]}
    ids = ["0a8dee9e8b4b", "0a8dee9e8b4c", "f00dee9e8b4b", "twin"]
    instances, ranges, gone, shortened = by_node(
        "drives", groups=groups, edit=edit, ids=ids,
        expression="""Promise.all([instancesOf(groups, edit), rowRanges(groups, instancesOf(groups, edit)),
          instancesOf(groups, { instances: [] }), ids.map((id) => shortId(id, ids))])""",
    )  # fmt: skip
    assert [(one["id"], one["scale"], one["samples"]) for one in instances] == [
        ("background", 1, None), ("car", 1, [0, 4]), ("twin", 2, [4, 9]),
    ]  # fmt: skip
    assert [(one["begin"], one["end"], one["row"]) for one in ranges] == [(0, 5, 0), (5, 8, 5), (5, 8, 8)]
    assert [one["id"] for one in gone] == ["background"]
    assert shortened == ["0a8dee9e8b4b", "0a8dee9e8b4c", "f00dee9e", "twin"]


def test_the_time_bar_marks_each_held_out_image_and_the_time_beyond_the_last_training_image():
    scene = {"held_out": {"interpolation": [1.0, 3.5], "extrapolation": [5.0]}, "last_training": 4.0}
    cases = [scene, {**scene, "last_training": None}, {"held_out": {}, "last_training": 6.0}]
    beyond, plain, nothing = by_node(
        "timebar", cases=cases, expression="cases.map((scene) => timeMarks(scene, [1, 6]))"
    )
    assert by_node("timebar", scene=scene, expression="timeMarks(scene, [1, 1])") == [], "a single image"
    held_out = [("interpolation", 0.0), ("interpolation", 0.5), ("extrapolation", 0.8)]
    assert [(mark["kind"], mark["left"]) for mark in plain] == held_out and plain == beyond[1:] and nothing == []
    assert beyond[0] == {"kind": "beyond", "left": 0.6, "width": 0.4}


def test_notes_name_what_no_training_image_saw_and_the_box_around_the_camera():
    states = [
        {"second": second, "following": following} for second, following in ((4.0, True), (4.1, True), (1.0, False))
    ]
    expression = """states.flatMap((state) => [notesOf(state, 4, null), notesOf(state, null, { name: "car 1" })])"""
    at_last, inside, beyond, also_inside, free, free_inside = by_node("notes", states=states, expression=expression)
    assert at_last == free == [] and len(beyond) == 1 and "Beyond the last training image (4.00 s)" in beyond[0]
    assert inside == also_inside == ["The camera is inside the box of car 1."]
    assert free_inside == [f"{inside[0]} Follow the camera of the drive (R) to leave it."]


def test_boxes_are_those_of_instances_and_of_further_tracks_while_they_are_there():
    turned = np.hstack([Rotation.from_euler("z", 0.5).as_matrix(), [[3.0], [4.0], [1.0]]]).ravel().tolist()
    instances = [
        {"id": "background", "samples": None, "size": None, "category": None},
        {"id": "0a8dee9e8b4b", "samples": [0, 2], "size": [4, 2, 1.5], "category": "vehicle.car"},
        {"id": "hidden", "samples": [0, 2], "size": [1, 1, 1], "category": "vehicle.car"},
    ]
    further = {"size": [1, 1, 2], "samples": [0, 2], "present": [[0, 1]]}
    scene = {"boxes": [
        {"id": "c0ffee9e8b4b", "category": "human.pedestrian.adult", **further},
        {"id": "f00dee9e8b4b", "category": "animal", **further, "present": [[2, 3]]},
    ]}  # fmt: skip
    arrays = {
        "box_seconds": [0, 1],
        "box_poses": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1, 0, 0, 2, 0, 1, 0, 0, 0, 0, 1, 0],
    }
    inside = np.array([3.0, 4.0, 1.0]) + Rotation.from_euler("z", 0.5).apply([1.9, 0.9, -0.7])
    outside = np.array([3.0, 4.0, 1.0]) + Rotation.from_euler("z", 0.5).apply([1.9, 1.1, 0.0])
    found, around, points = by_node(
        "camera", "drives", "motion", "lines", "boxes", scene=scene, arrays=arrays, instances=instances,
        poses=[[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], turned, None],
        at=[inside.tolist(), outside.tolist(), [1.4, 0.4, -0.9]],
        expression="""(() => {
          const boxes = boxesAt(scene, arrays, instances, poses, 0.5);
          return Promise.all([boxes, at.map((point) => (boxAround(boxes, point) || { name: null }).name),
            boxNames(boxes).map(({ point }) => point)]);
        })()""",
    )  # fmt: skip
    names = ["car 0a8dee9e", "pedestrian.adult c0ffee9e"]
    assert [(box["name"], box["modelled"]) for box in found] == list(zip(names, (True, False), strict=True))
    assert around == [names[0], None, names[1]]
    np.testing.assert_allclose(points, [[3.0, 4.0, 1.75], [1.0, 0.0, 1.0]])


def test_labels_differ_between_ids_and_depth_colours_are_those_of_range_images():
    ids = [f"{i:08x}" for i in range(40)]
    labels, still, colors = by_node(
        "looks", ids=ids,
        expression="""Promise.all([ids.map((id) => labelOf({ id, samples: [0, 1] })),
          labelOf({ id: "background", samples: null }), DEPTH_COLORS.map(rgbOf)])""",
    )  # fmt: skip
    assert np.min(labels) >= 0.0 and np.max(labels) <= 1.0 and np.max(labels, axis=1).min() > 0.5
    assert len({tuple(label) for label in labels}) > 35 and still[0] < 0
    np.testing.assert_allclose(colors, colormaps["viridis_r"](np.linspace(0.0, 1.0, 9))[:, :3], atol=0.5 / 255 + 1e-9)
