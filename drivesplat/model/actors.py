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
from drivesplat.kernels.placement import LocalGaussians, ObjectPoses, mirrored, of_owners, place
from drivesplat.kernels.quaternions import rotation_matrix
from drivesplat.kernels.time_varying_colors import colors_in_object, colors_in_world
from drivesplat.model.actor_placements import placement_sets, with_colors, with_placements
from drivesplat.model.gaussians import Gaussians, concatenate, without_colors
from drivesplat.model.harmonics import rotation_of_harmonics_by
from drivesplat.model.parameters import init_params, learning_rates, make_parameters
from drivesplat.model.part import ActorPlacement, Part, PartDefinition, RigidGroup
from drivesplat.model.timeline import ActorTrack, Timeline, TimeState
from drivesplat.model.track_penalties import track_penalties
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import ActorSettings
from drivesplat.trajectories.motion import HALF_STEP, Motion

MAX_SPREAD = 0.6
"""Maximum standard deviation of a Gaussian along an axis of its box, as a fraction of half the size of the box with its
margin. What fills a box evenly has 0.58."""


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
        self.params = make_parameters(params)
        annotations = sum(len(track.motion.times) for track in tracks)
        corrections = {"translation": torch.zeros(annotations, 3), "yaw": torch.zeros(annotations)}
        self.shared = make_parameters(corrections).requires_grad_(settings.tracks.corrected)
        self.extent = float(np.median([np.linalg.norm(track.size) for track in tracks]))
        self.cap_max = settings.cap_max
        self._settings = settings
        self._gaussians = gaussians
        self._known_owners: tuple[Tensor | None, int, Tensor | None] = (None, 0, None)
        sizes = torch.from_numpy(np.stack([track.size for track in tracks])).float()
        self.register_buffer("_reach", 0.5 * sizes + settings.box_margin, persistent=False)
        self.register_buffer("_annotated_actor", self.timeline.actor_of_annotations, persistent=False)
        self.register_buffer("_sizes", torch.ones(len(tracks)), persistent=False)
        self.register_buffer("_neighbours", self.timeline.neighbours, persistent=False)

    @classmethod
    def from_points(
        cls,
        tracks: Sequence[ActorTrack],
        points: Sequence[np.ndarray],
        colors: Sequence[np.ndarray],
        settings: ActorSettings,
        gaussians: GaussianSettings,
        classes: int = 0,
        echo: tuple[float, float] | None = None,
    ) -> "Actors":
        """Initialised from every track's points (p, 3) in its object's frame and their colours (p, 3) in [0, 1]; see
        `init_params`."""
        own = gaussians.model_copy(update={"sh_degree": settings.sh_degree})
        sets = [init_params(p, c, own, classes, echo) for p, c in zip(points, colors, strict=True)]
        params = {key: torch.cat([s[key] for s in sets]) for key in sets[0]}
        for key in ("sh0", "shN"):
            constant = params[key][:, None]
            varying = constant.new_zeros(len(constant), settings.fourier - 1, *constant.shape[2:])
            params[key] = torch.cat([constant, varying], dim=1)
        params["owner"] = torch.repeat_interleave(torch.arange(len(sets)), torch.tensor([len(p) for p in points]))
        return cls(params, tracks, settings, gaussians)

    def precompute(self, times: Sequence[float]) -> None:
        self.timeline.precompute(times, self.params["means"].device)

    def time_state(self, time: float) -> TimeState:
        return self.timeline.at(time, self.params["means"].device)

    def at_time_state(self, time_state: Sequence[Tensor]) -> Gaussians:
        state = TimeState(*time_state)
        return self.placed(state, self.poses(state))

    def scanned_at_time_state(self, time_state: Sequence[Tensor]) -> Gaussians:
        state = TimeState(*time_state)
        poses = self.poses(state)
        echoes = self._echoes(poses) if "echoes" in self.params else None
        return without_colors(*self._in_world(state, poses), echoes)

    def poses(self, state: TimeState) -> ObjectPoses:
        """The annotated poses of the actors with their learned corrections."""
        corrections = self._annotated_actor, self.shared["yaw"], self.shared["translation"]
        quats, translations = corrected(state.quats, state.translations, state.weights, *corrections)
        return ObjectPoses(quats, translations, self._sizes, state.present.to(self._sizes.dtype))

    def local(self, state: TimeState) -> LocalGaussians:
        """The Gaussians in the frames of their objects at a time state."""
        p = self.params
        return LocalGaussians(p["means"], p["quats"], p["scales"], p["opacities"])

    @torch.no_grad()
    def velocities_between(self, before: Sequence[Tensor], after: Sequence[Tensor]) -> Float[Tensor, "n 3"]:
        states = TimeState(*before), TimeState(*after)
        return self._velocities(*((state, self.poses(state)) for state in states))

    def echoes_at_time_state(self, time_state: Sequence[Tensor]) -> Float[Tensor, "n 4 2"] | None:
        return self._echoes(self.poses(TimeState(*time_state))) if "echoes" in self.params else None

    def _velocities(
        self, before: tuple[TimeState, ObjectPoses], after: tuple[TimeState, ObjectPoses]
    ) -> Float[Tensor, "n 3"]:
        """The velocities of its Gaussians, m/s, by states and poses HALF_STEP seconds before and after; 0 for actors
        that are absent then."""
        there = of_owners(before[1].presence * after[1].presence, self._owns)[:, None]
        return there * (self._in_world(*after)[0] - self._in_world(*before)[0]) / (2.0 * HALF_STEP)

    def _echoes(self, poses: ObjectPoses) -> Float[Tensor, "n 4 2"]:
        """The echoes of actors at these poses along directions in the world."""
        own, turns = self.params["echoes"], rotation_matrix(poses.quats.detach())
        turned = (of_owners(turns, self._owns)[..., None] * own[:, None, 1:]).sum(dim=2)  # faster than small matrices
        return torch.cat([own[:, :1], turned], dim=1)

    def _in_world(self, state: TimeState, poses: ObjectPoses) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means, unit quaternions, scales and opacities of its Gaussians in the world, mirrored by a state's `side`."""
        local = self.local(state)
        if self.mirrored is not None:
            local = mirrored(local, of_owners(state.side, self._owns))
        return place(local, poses, self.params["owner"], self._owns)

    def with_placements(self, time: float, placements: Sequence[ActorPlacement]) -> Gaussians:
        state, known = self.time_state(time), self._known
        poses, sets = self.poses(state), []
        for chosen, rows in self._sets(placements):  # few: transforming all actors for each copy costs little
            own = [placements[i] for i in chosen]
            there = self._state_with(state, own), with_placements(poses, known, own)
            sets.append(with_colors(self.placed(*there), known, self.params["owner"], own)[rows])
        return concatenate(sets)

    @torch.no_grad()
    def velocities_with_placements(self, time: float, placements: Sequence[ActorPlacement]) -> Float[Tensor, "m 3"]:
        recorded, known, sets = self._beside(time), self._known, []
        for chosen, rows in self._sets(placements):
            beside = []
            for number, state in enumerate(recorded):
                own = [placements[i].beside(number) for i in chosen]
                beside.append((self._state_with(state, own), with_placements(self.poses(state), known, own)))
            sets.append(self._velocities(*beside)[rows])
        return torch.cat(sets)

    def echoes_with_placements(
        self, time: float, placements: Sequence[ActorPlacement]
    ) -> Float[Tensor, "m 4 2"] | None:
        if "echoes" not in self.params:
            return None
        poses, known = self.poses(self.time_state(time)), self._known
        placed = (
            (with_placements(poses, known, [placements[i] for i in chosen]), rows)
            for chosen, rows in self._sets(placements)
        )
        return torch.cat([self._echoes(of_set)[rows] for of_set, rows in placed])

    def placement_of_rows(self, placements: Sequence[ActorPlacement]) -> Int[Tensor, " m"]:
        numbers, known = [], self._known
        for chosen, rows in self._sets(placements):
            of_actors = self.params["owner"].new_full((len(known),), -1)
            for i in chosen:
                of_actors[known.index(placements[i].source)] = i
            numbers.append(of_actors[self.params["owner"]][rows])
        return torch.cat(numbers)

    def _sets(self, placements: Sequence[ActorPlacement]) -> list[tuple[list[int], slice | Bool[Tensor, " n"]]]:
        return placement_sets(self._known, self.params["owner"], placements)

    @property
    def _known(self) -> list[str]:
        """The ids of its tracks."""
        return [track.id for track in self.timeline.tracks]

    def _state_with(self, state: TimeState, placements: Sequence[ActorPlacement]) -> TimeState:
        """The time state that placements give their actors; rigid ones have no limbs that would follow a path."""
        return state

    def placed(self, state: TimeState, poses: ObjectPoses) -> Gaussians:
        """The Gaussians in world coordinates with their actors placed anywhere, in the colours of a time state."""
        p, side = self.params, None if self.mirrored is None else state.side
        # colors rotate by a few degrees: their gradient would add only noise to the track
        rotations = rotation_of_harmonics_by(poses.quats, p["shN"].shape[2] + 1, side)
        colors = colors_in_world(p["sh0"], p["shN"], state.series, rotations, p["owner"], self._owns)
        return Gaussians(*self._in_world(state, poses), *colors)

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

    def harmonics(self, state: TimeState) -> Float[Tensor, "n k 3"]:
        """The colour coefficients at a time state, in the object's frame: the sum over i of f_i cos(i pi t / T), t
        running from 0 to T over the actor's annotations (equation 5 of the paper)."""
        return colors_in_object(self.params["sh0"], self.params["shN"], state.series, self._owns)

    def learning_rates(self) -> dict[str, float]:
        tracks = self._settings.tracks
        own = learning_rates(self._gaussians, self.extent)
        return {**own, "translation": tracks.lr_translation, "yaw": tracks.lr_yaw}

    def definition(self) -> PartDefinition:
        return PartDefinition(self.name, self.extent, self.timeline.tracks)

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        tracks = self._settings.tracks
        if not tracks.corrected:
            return {}
        return track_penalties(self.shared["translation"], self.shared["yaw"], self._neighbours, tracks)

    @torch.no_grad()
    def confine(self) -> None:
        """Fades Gaussians with centres outside their box, and shrinks those that spread beyond it. A LiDAR cannot tell
        a piece of road that moves with a car from road that stands still; without the limit such Gaussians may grow."""
        p, reach = self.params, of_owners(self._reach, self._owns)
        self.fade((p["means"].abs() > reach).any(dim=1))
        axes = rotation_matrix(normalize(p["quats"], dim=1)) * torch.exp(p["scales"])[:, None]
        excess = (axes.norm(dim=2) / (MAX_SPREAD * reach)).amax(dim=1, keepdim=True)
        p["scales"].sub_(excess.clamp(min=1.0).log())

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
        known = self._known
        return self.params["owner"] == known.index(track_id) if track_id in known else None

    @torch.no_grad()
    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        state = self.time_state(time)
        means, quats, scales, opacities = self.local(state)
        local = Gaussians.of(means, quats, torch.exp(scales), torch.sigmoid(opacities), self.harmonics(state))
        return {
            track.id: RigidGroup(local[self.params["owner"] == i], motion)
            for i, (track, motion) in enumerate(zip(self.timeline.tracks, self.motions(), strict=True))
        }

    @torch.no_grad()
    def motions(self) -> list[Motion]:
        """The motion of every track with its learned corrections."""
        shifts, turns = (self.shared[key].double().cpu().numpy() for key in ("translation", "yaw"))
        motions = []
        for track, own in zip(self.timeline.tracks, self.timeline.owned, strict=True):
            poses = track.motion.object_to_world.copy()
            poses[:, :3, 3] += shifts[own]
            motions.append(replace(track.motion, object_to_world=poses, turns=turns[own]))
        return motions
