"""The moving actors: a set of Gaussians per track, in the frame of its box, all transformed in one batch.

After Street Gaussians (Yan et al. 2024, arXiv 2401.01339): Gaussians are transformed by the track, small corrections of
the boxes are learned, and colours vary with time as a Fourier series over the track's duration. Colours are functions
of the direction in the object's frame: their spherical harmonics rotate with it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from drivesplat.kernels import torch_private
from drivesplat.kernels.object_poses import corrected
from drivesplat.kernels.placement import (
    LocalGaussians,
    ObjectPoses,
    colors_in_object,
    colors_in_world,
    mirrored,
    of_owners,
    place,
)
from drivesplat.kernels.quaternions import rotation_matrix
from drivesplat.kernels.regularizers import sums_of_squares
from drivesplat.model.actor_placements import (
    Columns,
    Posed,
    first_and_copies,
    placement_table,
    with_colors,
    with_placements,
)
from drivesplat.model.gaussians import Gaussians, concatenate, no_colors
from drivesplat.model.handover import Handover, are_alike, is_visible, same_track
from drivesplat.model.harmonics import rotation_of_harmonics_by
from drivesplat.model.parameters import fade, init_params, learning_rates, make_parameters
from drivesplat.model.part import Part, PartDefinition, RigidGroup
from drivesplat.model.states import IMAGE, State, Want
from drivesplat.model.timeline import ActorTrack, Timeline, TimeState
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import ActorSettings, TrackSettings
from drivesplat.trajectories.motion import HALF_STEP

MAX_OVERHANG_M, MIN_SPREAD_M = 0.15, 0.03
"""How far two standard deviations of a Gaussian may reach beyond its box with its margin, and the standard deviation
that is always allowed."""


class Actors(Part):
    """The Gaussians of a tracks, n in all; `params["owner"]` (n,) is the index of each one's track.

    `sh0` (n, f, 1, 3) and `shN` (n, f, k - 1, 3) hold f Fourier coefficients of every colour coefficient. `shared`
    holds the corrections at all m annotations, track after track: `translation` (m, 3) metres along the world's axes,
    `yaw` (m,) radians about the object's vertical axis.
    """

    name = "actors"
    moves = True
    has_objects = True
    _per_annotation: tuple[str, ...] = ("translation", "yaw")
    _per_track: tuple[str, ...] = ()
    """Entries of `shared` with a row for each annotation, and those with a row for each track."""

    def __init__(
        self,
        params: dict[str, Tensor],
        tracks: Sequence[ActorTrack],
        settings: ActorSettings,
        gaussians: GaussianSettings,
    ):
        super().__init__()
        self.timeline = Timeline(tracks, settings.fourier)
        self.ids = [track.id for track in tracks]
        self.params = make_parameters(params)
        annotations = sum(len(track.motion.times) for track in tracks)
        corrections = {"translation": torch.zeros(annotations, 3), "yaw": torch.zeros(annotations)}
        self.shared = make_parameters(corrections).requires_grad_(settings.tracks.corrected)
        self.extent = float(np.median([np.linalg.norm(track.size) for track in tracks]))
        self.cap_max = settings.cap_max
        self.settings = settings
        self._gaussians = gaussians
        self._known_owners: tuple[Tensor | None, int, Tensor | None] = (None, 0, None)
        sizes = torch.from_numpy(np.stack([track.size for track in tracks])).float()
        self.register_buffer("_reach", 0.5 * sizes + settings.box_margin, persistent=False)
        self.register_buffer("_annotated_actor", self.timeline.actor_of_annotations, persistent=False)
        self.register_buffer("_sizes", torch.ones(len(tracks)), persistent=False)
        self.register_buffer("_neighbours", self.timeline.neighbours, persistent=False)
        self._bend_scale = self.timeline.bend_scale

    @classmethod
    def from_points(
        cls,
        tracks: Sequence[ActorTrack],
        points: Sequence[np.ndarray],
        colors: Sequence[np.ndarray],
        settings: ActorSettings,
        gaussians: GaussianSettings,
        classes: int = 0,
        lidar_logits: tuple[float, float] | None = None,
    ) -> "Actors":
        """Initialised from every track's points (p, 3) in its object's frame and their colours (p, 3) in [0, 1]; see
        `init_params`."""
        own = gaussians.model_copy(update={"sh_degree": settings.sh_degree})
        sets = [init_params(p, c, own, classes, lidar_logits) for p, c in zip(points, colors, strict=True)]
        params = {key: torch.cat([s[key] for s in sets]) for key in sets[0]}
        for key in ("sh0", "shN"):
            constant = params[key][:, None]
            varying = constant.new_zeros(len(constant), settings.fourier - 1, *constant.shape[2:])
            params[key] = torch.cat([constant, varying], dim=1)
        params["owner"] = torch.repeat_interleave(torch.arange(len(sets)), torch.tensor([len(p) for p in points]))
        return cls(params, tracks, settings, gaussians)

    def precompute(self, times: Sequence[float], want: Want = IMAGE) -> None:
        every = [time + seconds for time in times for seconds in _apart(want)]
        self.timeline.precompute(every, self.params["means"].device)

    def state(self, time: float, want: Want = IMAGE) -> State:
        self.precompute([time], want)
        device = self.params["means"].device
        known = [self.timeline.at(time + seconds, device) for seconds in _apart(want)]
        if want.placements is None:
            return State(*known)
        first, _ = first_and_copies(self.ids, want.placements)
        return State(*known, placed=self._table(want, first).unbind())

    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        now = self.posed(state.now)
        with torch.no_grad():
            beside = [known for known in (state.before, state.after) if known is not None] if want.velocities else []
            around = [self.posed(known) for known in beside]
        if want.placements is None:
            return self._placed(want, now, *around)
        assert state.placed is not None
        first, copies = first_and_copies(self.ids, want.placements)
        sets = [self._at(want, first, state.placed, now, *around)]
        for i in copies:  # few, so all actors for each copy
            found = self._at(want, [i], self._table(want, [i]).unbind(), now, *around)
            sets.append(found[self.params["owner"] == self.ids.index(want.placements[i].source)])
        return concatenate(sets)

    def _table(self, want: Want, chosen: Sequence[int]) -> Float[Tensor, "t a c"]:
        """Some of the placements, at most one of each actor, at the times of a state."""
        assert want.placements is not None
        own, device = [want.placements[i] for i in chosen], self.params["means"].device
        return placement_table(self.ids, own, chosen, len(_apart(want)), device)

    def _at(self, want: Want, chosen: Sequence[int], placed: Sequence[Tensor], *known: Posed) -> Gaussians:
        """The Gaussians of all actors at some of the placements, which `placed` are at the times of `known`."""
        assert want.placements is not None
        owner = self.params["owner"]
        found = self._placed(want, *(self._moved(one, rows) for one, rows in zip(known, placed, strict=True)))
        if want.colors:
            found = with_colors(found, self.ids, owner, [want.placements[i] for i in chosen])
        return replace(found, placement=Columns.of(placed[0]).numbers[:, 0].long()[owner])

    def _placed(self, want: Want, now: Posed, *around: Posed) -> Gaussians:
        """The Gaussians in world coordinates with their actors placed anywhere, in the colours of a time state;
        velocities by the actors HALF_STEP seconds before and after."""
        p, (means, *shapes) = self.params, self._in_world(now)
        if not want.colors:
            colors = no_colors(means)
        else:
            side = None if self.mirrored is None else now.state.side
            # colors rotate by a few degrees: their gradient would add only noise to the track
            rotations = rotation_of_harmonics_by(now.poses.quats, p["shN"].shape[2] + 1, side)
            colors = colors_in_world(p["sh0"], p["shN"], now.state.series, rotations, p["owner"], self._owns)
        velocities = self._velocities(*around) if want.velocities else None
        logits = self._lidar_logits(now.poses) if want.lidar and "lidar_logits" in p else None
        return Gaussians(means, *shapes, *colors, velocities, logits)

    def posed(self, time_state: Sequence[Tensor]) -> Posed:
        """The actors at their annotated poses with learned corrections, by the tensors of a time in a `state`."""
        state = TimeState(*time_state)
        corrections = self._annotated_actor, self.shared["yaw"], self.shared["translation"]
        quats, translations = corrected(state.quats, state.translations, state.weights, *corrections)
        return Posed(state, ObjectPoses(quats, translations, self._sizes, state.present.to(self._sizes.dtype)))

    def _moved(self, known: Posed, rows: Float[Tensor, "a c"]) -> Posed:
        """The actors at the placements of a table; rigid ones have no limbs that would follow a path."""
        return Posed(known.state, with_placements(known.poses, rows))

    def local(self, state: TimeState) -> LocalGaussians:
        """The Gaussians in the frames of their objects at a time state."""
        p = self.params
        return LocalGaussians(p["means"], p["quats"], p["scales"], p["opacities"])

    @torch.no_grad()
    def _velocities(self, before: Posed, after: Posed) -> Float[Tensor, "n 3"]:
        """The velocities of its Gaussians, m/s; 0 for actors that are absent before or after."""
        there = of_owners(before.poses.presence * after.poses.presence, self._owns)[:, None]
        return there * (self._in_world(after)[0] - self._in_world(before)[0]) / (2.0 * HALF_STEP)

    def _lidar_logits(self, poses: ObjectPoses) -> Float[Tensor, "n 4 2"]:
        """Those of actors at these poses along directions in the world."""
        own, turns = self.params["lidar_logits"], rotation_matrix(poses.quats.detach())
        turned = (of_owners(turns, self._owns)[..., None] * own[:, None, 1:]).sum(dim=2)  # faster than small matrices
        return torch.cat([own[:, :1], turned], dim=1)

    def _in_world(self, now: Posed) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, unit quaternions, scales and opacities of its Gaussians in the world, mirrored by a state's `side`."""
        local = self.local(now.state)
        if self.mirrored is not None:
            local = mirrored(local, of_owners(now.state.side, self._owns))
        return place(local, now.poses, self.params["owner"], self._owns)

    @property
    def _owns(self) -> Float[Tensor, "n a"]:
        """The ownership matrix: 1 where a Gaussian is an actor's, else 0. Cached until densification changes `owner`;
        computed within every CUDA graph, since replays of a training iteration may follow a densification."""
        owner, (known, version, matrix) = self.params["owner"], self._known_owners
        captured = owner.is_cuda and torch.cuda.is_current_stream_capturing()
        changed = known is not owner or version != torch_private.write_count(owner)
        if matrix is None or changed or captured or matrix.device != owner.device:
            matrix = one_hot(owner, len(self.timeline.tracks)).float()
            if not captured:  # a captured matrix has no values before a replay
                self._known_owners = owner, torch_private.write_count(owner), matrix
        return matrix

    def learning_rates(self) -> dict[str, float]:
        tracks = self.settings.tracks
        own = learning_rates(self._gaussians, self.extent)
        return {**own, "translation": tracks.lr_translation, "yaw": tracks.lr_yaw}

    def definition(self) -> PartDefinition:
        return PartDefinition(self.name, self.extent, self.timeline.tracks)

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        tracks = self.settings.tracks
        if not tracks.corrected:
            return {}
        corrections = self.shared["translation"], self.shared["yaw"]
        return track_penalties(*corrections, self._neighbours, self._bend_scale, tracks)

    @torch.no_grad()
    def confine(self) -> None:
        """Fades Gaussians with centres outside their box, and shrinks those that spread beyond it: to the cameras of
        one side they look right, and from other sides they are spikes. A LiDAR cannot tell a piece of road that moves
        with a car from road that stands still; without the limit such Gaussians may grow."""
        p, reach = self.params, of_owners(self._reach, self._owns)
        fade(p, (p["means"].abs() > reach).any(dim=1))
        axes = rotation_matrix(normalize(p["quats"], dim=1)) * torch.exp(p["scales"])[:, None]
        allowed = ((reach + MAX_OVERHANG_M - p["means"].abs()) / 2).clamp(min=MIN_SPREAD_M)
        excess = (axes.norm(dim=2) / allowed).amax(dim=1, keepdim=True)
        p["scales"].sub_(excess.clamp(min=1.0).log())

    @torch.no_grad()
    def take_over(self, other: Part, handover: Handover) -> None:
        """Objects of both blocks start from their Gaussians there, in the colours that they had at the last annotation
        that is in both, and from their corrections. Objects without a common annotation start from their seed."""
        if not isinstance(other, Actors) or not are_alike(self.params, other.params):
            return
        sets = [{name: values.detach() for name, values in self.params.items()}]
        for i, track in enumerate(self.timeline.tracks):
            j = other.ids.index(track.id) if track.id in other.ids else None
            common = [] if j is None else same_track(other.timeline.tracks[j].motion, track.motion, handover)
            learned = {} if j is None or not common else other._constant_rows(j, common[-1][0])
            if j is None or not learned or not len(learned["owner"]):
                continue
            sets[0] = {name: values[sets[0]["owner"] != i] for name, values in sets[0].items()}
            sets.append(learned | {"owner": torch.full_like(learned["owner"], i)})
            self._take_over_track(i, other, j, common)
        rows = {name: torch.cat([own[name] for own in sets]) for name in sets[0]}
        self.params = make_parameters(rows)
        self.cap_max = max(self.cap_max or 0, len(rows["owner"]))

    def _constant_rows(self, i: int, annotation: int) -> dict[str, Tensor]:
        """The visible Gaussians of a track, in the colours at one of its annotations for all times."""
        visible = (self.params["owner"] == i) & is_visible(self.params)
        rows = {name: values.detach()[visible] for name, values in self.params.items()}
        time = float(self.timeline.tracks[i].motion.times[annotation])
        series = self.timeline.at(time, rows["sh0"].device).series[i]
        for name in ("sh0", "shN"):
            constant = (rows[name] * series[:, None, None]).sum(dim=1, keepdim=True)
            rows[name] = torch.cat([constant, torch.zeros_like(rows[name][:, 1:])], dim=1)
        return rows

    def _take_over_track(self, i: int, other: "Actors", j: int, common: Sequence[tuple[int, int]]) -> None:
        """Starts what `shared` has of track i from what that of another model has of its track j; `common` are the
        annotations (there, here) of both."""
        there, here = (torch.tensor(indices) for indices in zip(*common, strict=True))
        start, other_start = self.timeline.owned[i].start, other.timeline.owned[j].start
        for name in self._per_annotation:
            self.shared[name][start + here] = other.shared[name][other_start + there]
        for name in self._per_track:
            if self.shared[name].shape[1:] == other.shared[name].shape[1:]:
                self.shared[name][i] = other.shared[name][j]

    @torch.no_grad()
    def broken_tracks(self) -> list[str]:
        rows = torch.zeros_like(self.params["opacities"], dtype=torch.bool)
        for values in self.params.values():
            rows |= ~torch.isfinite(values).flatten(1).all(dim=1) if values.dim() > 1 else ~torch.isfinite(values)
        broken = {int(i) for i in self.params["owner"][rows].unique()}
        for i, own in enumerate(self.timeline.owned):
            of_track = [self.shared[name][own] for name in self._per_annotation]
            of_track += [self.shared[name][i] for name in self._per_track]
            if not all(bool(torch.isfinite(values).all()) for values in of_track):
                broken.add(i)
        return [self.timeline.tracks[i].id for i in sorted(broken)]

    def of_track(self, track_id: str) -> Bool[Tensor, " n"] | None:
        return self.params["owner"] == self.ids.index(track_id) if track_id in self.ids else None

    @torch.no_grad()
    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        p, state = self.params, TimeState(*self.state(time).now)
        means, quats, scales, opacities = self.local(state)
        colors = colors_in_object(p["sh0"], p["shN"], state.series, self._owns)
        local = Gaussians.of(means, quats, torch.exp(scales), torch.sigmoid(opacities), colors)
        motions = self.timeline.corrected(*(self.shared[key].double().cpu().numpy() for key in ("translation", "yaw")))
        return {name: RigidGroup(local[p["owner"] == i], motions[i]) for i, name in enumerate(self.ids)}


def _apart(want: Want) -> tuple[float, ...]:
    """The seconds from a time to those of its states."""
    return (0.0, -HALF_STEP, HALF_STEP) if want.velocities else (0.0,)


def track_penalties(
    translation: Float[Tensor, "m 3"],
    yaw: Float[Tensor, " m"],
    neighbours: Int[Tensor, "q 3"],
    bend_scale: float,
    settings: TrackSettings,
) -> dict[str, Float[Tensor, ""]]:
    """The penalties of learned corrections of tracks: their mean square, and that of their second differences along the
    tracks, both in units of the expected annotation error. `neighbours` are all triples of consecutive annotations,
    `bend_scale` is `Timeline.bend_scale`."""
    size, bend = sums_of_squares(translation, yaw, neighbours, settings.sigma_translation, settings.sigma_yaw)
    penalties = {"track_size": settings.l2_weight / max(1, len(yaw)) * size}
    if len(neighbours):
        penalties["track_bend"] = settings.smoothness_weight * bend_scale / len(neighbours) * bend
    return penalties
