"""The method `street` in one file: a recorded drive with moving vehicles as 3D Gaussians, trained and measured.

    snakemake --cores 2 --configfile presets/demo.yaml -- results/demo/metrics.json  # makes the files read here
    python street.py results/demo --iterations 800 --cap-max 40000 --max-scale 0.1  # the demo's settings; minutes
    python street.py results/0061  # a recorded drive with the workflow's defaults, on a GPU

After Street Gaussians (Yan et al. 2024, arXiv 2401.01339). What a camera sees at a time consists of
    background  static Gaussians in the world, at first one for each seed point, mostly of LiDAR (`Part`);
    actors      Gaussians of moving vehicles in the frames of their boxes, which tracks place in the world (`Actors`);
    sky         a cube map behind both (`Sky`).
`Street.render` shows them, `losses` compares that with an image and its LiDAR depth, `train` learns by Adam and MCMC
(`Part.densify`), `evaluate` measures static and moving pixels of held-out images. World: metres, z up. Cameras: OpenCV
axes. Quaternions: w, x, y, z. Shapes: n Gaussians, a actors with m annotations in all, images of h rows and w columns.

The rest of the repository makes this fast, exact and measured, and a test compares it with this file. It adds the road
as a part, rolling shutters, exposures, reduced images, colours where no image looks, LiDAR scans, resuming and more.
"""

import json
import math
import pickle
import time
from argparse import ArgumentParser, Namespace
from collections import namedtuple
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from scipy.linalg import block_diag
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from drivesplat.kernels.color_difference import ssim
from drivesplat.lidar.depth_record import read_lidar_depth
from drivesplat.lidar.ground import GroundMap
from drivesplat.rasterization import Rendering, rasterize
from drivesplat.scene.images import read_image
from drivesplat.scene.masks import read_labels, read_sky_mask
from drivesplat.scene.regions import LABELS, REGIONS
from drivesplat.trajectories.actor_record import ActorRecord, read_actors

RATES = {"means": 1.6e-4, "scales": 1e-2, "quats": 2e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
RATES |= {"translation": 1e-3, "yaw": 5e-4, "texels": 1e-2}  # that of means is in units of the extent of a part
Adam = partial(torch.optim.Adam, eps=1e-15, fused=True)
DEAD, FADED = 0.005, math.log(1e-4 / (1.0 - 1e-4))  # opacity up to which Gaussians are relocated; a logit below it
Gaussians = namedtuple("Gaussians", "means quats scales opacities sh")
"""In the world: (n, 3) metres, (n, 4), (n, 3) metres, (n,) in [0, 1], (n, 4, 3) harmonics of RGB: of 1, -y, z, -x."""
Picture = namedtuple("Picture", "image alpha depth actors_alpha gaussians")
"""(h, w, 3) with the sky, (h, w) of all Gaussians, (h, w) metres, (h, w) of actors alone or None, and `Gaussians`."""
View = namedtuple("View", "K camera_to_world pixels sky ego static moving dynamic lidar_pixels lidar_depth time")
"""An image: (3, 3), pixels with centres at halves; (4, 4); (h, w, 3) uint8; masks (h, w) of the sky, the ego vehicle,
static pixels (no box of a vehicle, person or animal; with sky), moving vehicles, these and moving people; row-major
indices (k,) of pixels with LiDAR depth (k,) in metres along the optical axis; seconds since the first image."""


def read_views(folder: Path, record: dict, images: np.ndarray, device: torch.device) -> list[View]:
    """Images of parser.pkl by number. Held-out ones have no LiDAR depth."""
    depths, moving, views = read_lidar_depth(folder / "lidar_depth.npz").images, REGIONS["moving_vehicle"], []
    for i in images:
        camera, size = record["camera_names"][record["camera_indices"][i]], tuple(record["image_sizes"][i].tolist())
        of_image = folder / "masks", camera, int(record["timestamps"][i]), size
        labels, lidar = read_labels(*of_image), depths[i]
        regions = ("own_car",), REGIONS["static"], moving, moving + REGIONS["moving_human"]
        masks = [np.isin(labels, [LABELS[name] for name in names]) for names in regions]
        seen = ~masks[0][lidar.rows, lidar.columns]
        measured = (lidar.rows.astype(np.int64) * size[0] + lidar.columns)[seen], np.float32(lidar.depth[seen])
        cameras = np.float32(record["Ks"][i]), np.float32(record["camtoworlds"][i])
        shown = read_image(record["image_paths"][i], size), read_sky_mask(*of_image)
        tensors = (torch.tensor(values, device=device) for values in (*cameras, *shown, *masks, *measured))
        views.append(View(*tensors, time=float(record["timestamps"][i] - record["timestamps"].min()) * 1e-6))
    return views


def rotate(quats: Tensor, vectors: Tensor, back: bool = False) -> Tensor:
    """Vectors (..., 3) rotated by unit quaternions (..., 4), or by their inverses."""
    axis = (-quats if back else quats)[..., 1:].expand(vectors.shape)
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors + quats[..., :1] * twice + torch.linalg.cross(axis, twice)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Quaternions (..., 4) of the rotations by b, then by a."""
    (s, v), (t, w) = a.split([1, 3], dim=-1), b.split([1, 3], dim=-1)
    return torch.cat([s * t - (v * w).sum(dim=-1, keepdim=True), s * w + t * v + torch.linalg.cross(v, w)], dim=-1)


def init_params(points: np.ndarray, colors: np.ndarray, limit: int) -> dict[str, Tensor]:
    """Parameters of a faint Gaussian at each of the points (k, 3), of at most `limit`, with its colour (k, 3) uint8."""
    kept = np.sort(np.random.default_rng(0).choice(len(points), min(limit, len(points)), replace=False))
    points, colors, count = points[kept], colors[kept], len(kept)
    to_neighbours = cKDTree(points).query(points, k=4, workers=-1)[0][:, 1:]
    scales = np.log((0.4 * np.sqrt((to_neighbours**2).mean(axis=1))).clip(1e-4))
    return {
        "means": torch.from_numpy(points).float(),
        "scales": torch.from_numpy(scales).float()[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "opacities": torch.full((count,), math.log(0.1 / 0.9)),
        "sh0": (torch.from_numpy(colors / 255.0).float()[:, None] - 0.5) / 0.28209479177387814,
        "shN": torch.zeros(count, 3, 3),
    }


class Part:
    """Gaussians that are learned and densified together, at most `cap` of them over `extent` metres: the background.
    `params` have gsplat's names: `scales` are logarithms, `opacities` logits, `owner` is the index of an actor."""

    def __init__(self, params: dict[str, Tensor], extent: float, cap: int, args: Namespace, device: torch.device):
        self.params = {name: nn.Parameter(v.to(device), v.is_floating_point()) for name, v in params.items()}
        self.cap, self.args, self.lr_means = cap, args, extent * RATES["means"]
        self.adam = {name: Adam([values], RATES[name]) for name, values in self.params.items() if name in RATES}

    def at(self, time: float) -> Gaussians:
        """The Gaussians in the world at a time in seconds."""
        p = self.params
        opacities, sh = torch.sigmoid(p["opacities"]), torch.cat([p["sh0"], p["shN"]], dim=1)
        return Gaussians(p["means"], p["quats"], torch.exp(p["scales"]), opacities, sh)

    def fade(self, rows: Tensor) -> None:
        """Makes Gaussians transparent. Densification then relocates them."""
        self.params["opacities"].masked_fill_(rows & (self.params["opacities"] > FADED), FADED)

    @torch.no_grad()
    def densify(self, step: int) -> None:
        """3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024, arXiv 2404.09591): now and then
        dead Gaussians are relocated to others, drawn by opacity, and copies of others are added; always all explore."""
        p, (start, stop) = self.params, (int(fraction * self.args.iterations) for fraction in (0.0167, 0.833))
        if start < step < stop and step % 100 == 0:
            opacities = torch.sigmoid(p["opacities"])
            dead, alive = (rows.nonzero()[:, 0] for rows in (opacities <= DEAD, opacities > DEAD))
            if len(dead) and len(alive):
                self.copy(alive[torch.multinomial(opacities[alive], len(dead), replacement=True)], dead)
            if more := max(0, min(self.cap, int(1.05 * len(opacities))) - len(opacities)):
                self.copy(torch.multinomial(torch.sigmoid(p["opacities"]), more, replacement=True))
        # equation 8: noise in the shape of a Gaussian, Σ @ noise, for those that are nearly transparent
        rate, quats = self.adam["means"].param_groups[0]["lr"], F.normalize(p["quats"], dim=1)
        noise = 5e5 * rate * torch.sigmoid(100.0 * (0.005 - torch.sigmoid(p["opacities"])))[:, None]
        along_axes = rotate(quats, noise * torch.randn_like(p["means"]), back=True)
        p["means"] += rotate(quats, along_axes * torch.exp(2.0 * p["scales"]))

    def copy(self, source: Tensor, target: Tensor | None = None) -> None:
        """Copies Gaussians over those in the rows `target`, or adds the copies. N coincident ones look as one did
        before by equation 9; its sum of binomial coefficients over i is a binomial coefficient, too."""
        p, copies = self.params, (torch.bincount(source)[source] + 1).clamp(max=51)[:, None].double()
        before, k = torch.sigmoid(p["opacities"][source]).double()[:, None], torch.arange(1.0, 52.0).to(copies)
        after = 1.0 - (1.0 - before) ** (1.0 / copies)
        of_n = torch.lgamma(copies + 1) - torch.lgamma(k + 1) - torch.lgamma((copies - k).clamp(min=0) + 1)
        series = (-1.0) ** (k - 1) * after**k / torch.sqrt(k) * torch.exp(of_n) * (k <= copies)
        p["scales"][source] += torch.log(before / series.sum(dim=1, keepdim=True)).float()
        p["opacities"][source] = torch.logit(after[:, 0].float().clamp(DEAD, 1.0 - torch.finfo().eps))
        for name, old in p.items():
            rows = old[source]
            new = torch.cat([old, rows]) if target is None else old.index_copy(0, target, rows)
            p[name] = nn.Parameter(new, old.requires_grad)
            if name in self.adam:  # as gsplat: added copies have no moments; those of relocated sources are lost
                state = self.adam[name].state.pop(old)
                for key in ("exp_avg", "exp_avg_sq"):
                    m = state[key]
                    state[key] = torch.cat([m, 0.0 * rows]) if target is None else m.index_fill(0, source, 0.0)
                self.adam[name].state[p[name]], self.adam[name].param_groups[0]["params"] = state, [p[name]]


class Actors(Part):
    """Moving vehicles, their Gaussians in the frames of their boxes: x forward, y left, z up, origin at the centre.
    A spline through the annotated poses of its track places a vehicle. Corrections of the annotations are learned,
    `translation` (m, 3) in metres and `yaw` (m,) in radians, and interpolated by the same spline."""

    def __init__(self, actors: list[ActorRecord], args: Namespace, device: torch.device):
        limits = [max(500, int(actor.pixels / 20.0)) for actor in actors]
        cap = min(200_000, sum(limits))
        shares = [max(4, limit * cap // sum(limits)) for limit in limits]
        sets = [init_params(actor.points, actor.points_rgb, n) for actor, n in zip(actors, shares, strict=True)]
        params = {name: torch.cat([own[name] for own in sets]) for name in sets[0]}
        for name in ("sh0", "shN"):  # (n, 5, k, 3): a Fourier series over time, at first its constant term alone
            params[name] = F.pad(params[name][:, None], (0, 0, 0, 0, 0, 4))
        params["owner"] = torch.repeat_interleave(torch.tensor([len(own["means"]) for own in sets]))
        sizes = np.stack([actor.size for actor in actors])
        super().__init__(params, float(np.median(np.linalg.norm(sizes, axis=1))), cap, args, device)
        self.reach = torch.from_numpy(0.5 * sizes + 0.1).float().to(device)  # (a, 3) metres: Gaussians lie within
        self.motions, self.states = [actor.motion for actor in actors], {}
        self.runs = [torch.tensor(m.times[a : b + 1]).float().to(device) for m in self.motions for a, b in m.runs]
        zeros = (torch.zeros(sum(map(len, self.runs)), *row, device=device) for row in ((3,), ()))
        self.translation, self.yaw = map(nn.Parameter, zeros)
        self.adam |= {name: Adam([getattr(self, name)], RATES[name]) for name in ("translation", "yaw")}

    def state_at(self, time: float) -> list[Tensor]:
        """Of each actor: its pose by annotations as quaternion (a, 4) and translation (a, 3), their weights in it
        (a, m), presence (a,), 0 or 1, and cos(i π t / T) (a, 5), where t runs from 0 to T over its track."""
        if time not in self.states:
            at, motions = np.array([time]), self.motions
            poses = np.concatenate([motion.poses(at) for motion in motions])
            quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
            weights = block_diag(*(motion.weights(at) for motion in motions))
            present = np.concatenate([motion.present(at) for motion in motions])
            done = [np.clip((time - m.times[0]) / max(1e-9, np.ptp(m.times)), 0.0, 1.0) for m in motions]
            state = quats, poses[:, :3, 3], weights, present, np.cos(np.pi * np.outer(done, np.arange(5)))
            self.states[time] = [torch.tensor(values, dtype=torch.float32, device=self.yaw.device) for values in state]
        return self.states[time]

    def at(self, time: float) -> Gaussians:
        """The Gaussians in the world. Those of an actor that is absent have opacity 0."""
        quats, translations, weights, present, series = self.state_at(time)
        half, p = 0.5 * (weights @ self.yaw), self.params
        quats = product(quats, torch.stack([half.cos(), 0.0 * half, 0.0 * half, half.sin()], dim=1))
        of_actors = quats, translations + weights @ self.translation, present, series
        quats, translations, present, series = (values.index_select(0, p["owner"]) for values in of_actors)
        sh = (series[..., None, None] * torch.cat([p["sh0"], p["shN"]], dim=2)).sum(dim=1)
        vectors = torch.stack([-sh[:, 3], -sh[:, 1], sh[:, 2]], dim=2)  # reflections turn with the vehicle, but tracks
        x, y, z = rotate(quats.detach()[:, None], vectors).unbind(dim=2)  # would only learn noise from them: detach
        means, opacities = rotate(quats, p["means"]) + translations, torch.sigmoid(p["opacities"]) * present
        quats, sh = product(quats, F.normalize(p["quats"], dim=1)), torch.stack([sh[:, 0], -y, z, -x], dim=1)
        return Gaussians(means, quats, torch.exp(p["scales"]), opacities, sh)

    def penalty(self) -> Tensor:
        """Corrections shall be small for the expected errors of annotations, and smooth: they hold between images."""
        off = torch.cat([self.translation / 0.1, self.yaw[:, None] / 0.03], dim=1)
        runs = zip(off.split(list(map(len, self.runs))), self.runs, strict=True)  # with seconds, of nuScenes 0.5 apart
        bend = torch.cat([(v[:-2] - 2.0 * v[1:-1] + v[2:]) / (t[2:, None] - t[:-2, None]) ** 2 for v, t in runs])
        return sum(0.001 * values.square().sum() / max(1, len(values)) for values in (off, bend))


class Sky:
    """A cube map of colours, as logits; its faces are +x, -x, +y, -y, +z and -z."""

    def __init__(self, color: Tensor):
        self.texels = nn.Parameter(torch.logit(color.nan_to_num(0.5), 0.02).view(3, 1, 1, 1).repeat(1, 6, 128, 128))
        self.adam = {"texels": Adam([self.texels], RATES["texels"])}

    def colors(self, view: View) -> Tensor:
        """The colours (h, w, 3) that a view sees."""
        x, y = (torch.arange(count, device=view.K.device) + 0.5 for count in reversed(view.sky.shape))
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        in_camera = F.pad((pixels - view.K[:2, 2]) / view.K.diagonal()[:2], (0, 1), value=1.0)
        rays = in_camera @ view.camera_to_world[:3, :3].T  # of any length
        axis = rays.abs().argmax(dim=-1, keepdim=True)
        along = rays.gather(-1, axis)
        u, v = (rays.gather(-1, (axis + i) % 3) / along.abs() for i in (1, 2))
        face = (2 * axis + (along < 0)) * (2.0 / 5.0) - 1.0  # six faces one behind the other: a volume
        where = torch.cat([u, v, face], dim=-1)[None, None]
        logits = F.grid_sample(self.texels[None], where, padding_mode="border", align_corners=True)
        return torch.sigmoid(logits[0, :, 0].permute(1, 2, 0))


class Street:
    """The model: `parts`, the background and, with any moving vehicle, the actors; `sky`."""

    def __init__(self, record: dict, actors: list[ActorRecord], views: list[View], args: Namespace):
        device, cap = views[0].K.device, min(args.cap_max, sum(view.sky.numel() for view in views) // 20)
        params = init_params(record["points"], record["points_rgb"], cap)
        self.args, self.parts = args, [Part(params, record["scene_scale"], cap, args, device)]
        self.parts += [Actors(actors, args, device)] if actors else []
        self.sky = Sky(torch.cat([view.pixels[view.sky] for view in views]).double().mean(dim=0).float() / 255.0)
        self.optimizers = [optimizer for it in (*self.parts, self.sky) for optimizer in it.adam.values()]
        self.path = [view.camera_to_world[:3, 3] for view in views]
        ground = GroundMap(record["points"][: record["seed"]["lidar"]]).planes()  # through the lowest LiDAR points
        planes = torch.from_numpy(np.column_stack([ground.normals, ground.offsets])).float()
        self.places, self.planes = cKDTree(ground.places), F.pad(planes, (0, 0, 0, 1)).to(device)  # the last is none
        self.find_ground()

    def find_ground(self) -> None:
        """Looks up the plane of the ground (n, 4), normal and offset, at each static Gaussian, in cells of 0.25 m."""
        cells = (4.0 * self.parts[0].params["means"].detach()[:, :2].double().cpu()).floor()
        self.ground = self.planes[self.places.query((cells + 0.5) / 4.0, distance_upper_bound=1.0, workers=-1)[1]]

    def render(self, view: View, sh_degree: int = 1, dropout: float = 0.0) -> Picture:
        """What a view shows, by spherical harmonics up to a degree, without a random share of the static Gaussians."""
        sets = [part.at(view.time) for part in self.parts]
        opacities = sets[0].opacities
        sets[0] = sets[0]._replace(opacities=opacities * (torch.rand_like(opacities) >= dropout))
        shown = Gaussians(*(torch.cat(values) for values in zip(*sets, strict=True)))
        seen = self.splat(shown, shown.sh, view, sh_degree=sh_degree, with_depth=True)
        image = seen.image[0] + (1.0 - seen.alpha[0]) * self.sky.colors(view)
        alone = [self.splat(own, own.opacities[:, None].detach(), view).alpha[0, ..., 0] for own in sets[1:]]
        return Picture(image, seen.alpha[0, ..., 0], seen.depth[0, ..., 0], alone[0] if alone else None, shown)

    def splat(self, g: Gaussians, colors: Tensor, view: View, **options: int | bool) -> Rendering:
        """EWA splatting. It linearises the projection: what is large for its distance would look wrong."""
        distances = (g.means.detach() - view.camera_to_world[:3, 3]).norm(dim=1, keepdim=True)
        scales = torch.minimum(g.scales, (self.args.max_scale or math.inf) * distances)
        camera = torch.linalg.inv(view.camera_to_world)[None], view.K[None], view.sky.shape[1], view.sky.shape[0]
        return rasterize(g.means, g.quats, scales, g.opacities, colors, *camera, **options)

    @torch.no_grad()
    def fade_floaters(self) -> None:
        """Fades Gaussians outside their box, shrinks those that reach beyond it, fades static ones near the path."""
        for actors in self.parts[1:]:
            p, room = actors.params, actors.reach[actors.params["owner"]] - actors.params["means"].abs()
            actors.fade((room < 0.0).any(dim=1))
            in_box = rotate(F.normalize(p["quats"], dim=1)[:, None], torch.diag_embed(torch.exp(p["scales"])))
            p["scales"] -= (in_box.norm(dim=1) / (room / 2 + 0.075).clamp(min=0.03)).amax(1, True).clamp(min=1.0).log()
        points = self.parts[0].params["means"]
        for start, end in pairwise(self.path):
            along = (end - start) * ((end - start).norm() < 15.0)  # the vehicle drove there; beyond, images are missing
            fraction = ((points - start) @ along / along.square().sum().clamp(min=1e-12)).clamp(0.0, 1.0)
            self.parts[0].fade((points - start - fraction[:, None] * along).norm(dim=1) < 1.0)


def losses(picture: Picture, view: View, model: Street) -> dict[str, Tensor]:
    """The weighted terms of the loss. Pixels that show the ego vehicle have no effect."""
    target, g = view.pixels.float() / 255.0, picture.gaussians
    image, alpha = torch.where(view.ego[..., None], target, picture.image), picture.alpha.masked_fill(view.ego, 1.0)
    difference, opaque = (image - target).abs(), alpha.clamp(1e-4, 1.0 - 1e-4)
    terms = {
        "l1": 0.8 * difference.mean(),
        "ssim": 0.2 * (1.0 - ssim(image, target)),
        "opacity": 0.01 * g.opacities.mean(),  # fades Gaussians that images do not need (MCMC)
        "scale": 0.01 * (g.scales * (g.opacities.detach() > 0.0)[:, None]).mean(),
        "sky": -0.05 * torch.where(view.sky, 1.0 - opaque, opaque).log().mean(),  # no Gaussians there, but elsewhere
    }
    if len(view.lidar_depth):  # the worst 5 % are returns from behind edges
        off = (picture.depth.flatten()[view.lidar_pixels] - view.lidar_depth).abs()
        terms["depth"] = 0.01 * off.topk(max(1, len(off) * 95 // 100), largest=False).values.mean()
    if len(model.parts) > 1:  # dynamic pixels are few; actors are opaque, or absent
        terms["dynamic"] = 0.1 * (difference.mean(dim=2) * view.dynamic).sum() / view.dynamic.sum().clamp(min=1)
        o = picture.actors_alpha.masked_fill(view.ego, 1.0).clamp(1e-4, 1.0 - 1e-4)
        terms["entropy"] = -0.005 * (o * o.log() + (1.0 - o) * (1.0 - o).log()).mean()
        terms["tracks"] = model.parts[1].penalty()
    # near the ground, sqrt(d² + nᵀ Σ n): the distance of a Gaussian's mass from the plane with normal n; pseudo-Huber
    static = Gaussians(*(values[: len(model.ground)] for values in g))
    normal, offset = model.ground.split([3, 1], dim=1)
    height = (static.means * normal).sum(dim=1, keepdim=True) - offset
    along = rotate(F.normalize(static.quats, dim=1), normal, back=True) * static.scales
    near = (normal[:, 2:] > 0.0) & (height.abs() < 0.3) & (static.opacities > 0.0)[:, None]
    distance = torch.sqrt(height**2 + along.square().sum(dim=1, keepdim=True) + 0.05**2) - 0.05
    terms["ground"] = (near * distance).sum() / near.sum().clamp(min=1)
    return terms


def train(model: Street, views: list[View], cameras: int) -> None:
    """Fits the model to images of so many cameras, each of which is shown once before any is shown again."""
    args, parts, sums, count = model.args, model.parts, [], 0
    dropout = 0.2 * min(1.0, 20 * cameras / len(views))  # few images overfit
    torch.manual_seed(args.seed)
    for step in range(args.iterations):
        epoch, place = divmod(step, len(views))
        view = views[np.random.default_rng((args.seed, epoch)).permutation(len(views))[place]]
        for part in parts:
            part.adam["means"].param_groups[0]["lr"] = part.lr_means * 0.01 ** (step / args.iterations)
        sh_degree = min(1, step // max(1, int(0.0333 * args.iterations)))  # 0: colours are the same from all sides
        loss = sum(losses(model.render(view, sh_degree, dropout), view, model).values())
        loss.backward()
        for optimizer in model.optimizers:
            optimizer.step()
            optimizer.zero_grad()
        for part in parts:
            part.densify(step)
        if step % 100 == 0:
            model.find_ground()
            print(f"iteration {step}: loss {loss.item():.4f}, {len(model.ground)} static Gaussians", flush=True)
        if (step + 1) % 100 == 0:
            model.fade_floaters()
        if step >= int(0.9 * args.iterations) and (args.iterations - step - 1) % 5 == 0:
            learned, count = [one.param_groups[0]["params"][0].data for one in model.optimizers], count + 1
            sums = [total + values for total, values in zip(sums or [0.0] * len(learned), learned, strict=True)]
    for values, total in zip(learned, sums, strict=True):  # held-out images prefer the mean of the last iterations
        values.copy_(total / count)  # (Izmailov et al. 2018, arXiv 1803.05407)
    model.fade_floaters()  # in the mean, what was faded meanwhile is visible


@torch.no_grad()
def evaluate(model: Street, views: list[View]) -> dict[str, float | None]:
    """The PSNR (dB) of a region over all its pixels in held-out images; None where these are fewer than 1000."""
    sums = {"static": (0, 0.0), "moving": (0, 0.0)}  # number of pixels and squared error
    for view in views:
        squared = (model.render(view).image.clamp(0.0, 1.0) - view.pixels / 255.0).square().mean(dim=2).double()
        for region, (count, total) in sums.items():
            errors = squared[getattr(view, region)]
            sums[region] = count + len(errors), total + errors.sum().item()
    return {region: -10.0 * math.log10(e / n) if n >= 1000 else None for region, (n, e) in sums.items()}


def main() -> None:
    parser = ArgumentParser(description="Trains the method `street` on a prepared scene and measures it.")
    parser.add_argument("folder", type=Path, help="a scene's results: results/demo")
    parser.add_argument("--iterations", type=int, default=7_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cap-max", type=int, default=1_500_000, help="static Gaussians, at most")
    parser.add_argument("--max-scale", type=float, default=0.0, help="of Gaussians in units of their distance")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--camera", default="CAM_FRONT", help="the camera whose held-out images are measured")
    args = parser.parse_args()
    record, device = pickle.loads((args.folder / "parser.pkl").read_bytes()), torch.device(args.device)
    actors = [actor for actor in read_actors(args.folder / "actors.npz").actors if actor.part_in(("actors",))]
    splits, cameras, began = record["splits"], record["camera_indices"], time.monotonic()
    views = read_views(args.folder, record, splits["train"], device)
    model = Street(record, actors, views, args)
    train(model, views, len(np.unique(cameras[splits["train"]])))
    figures = {"iterations": args.iterations, "seed": args.seed, "seconds": round(time.monotonic() - began, 1)}
    measured = np.flatnonzero(record["is_key_frame"] & (cameras == record["camera_names"].index(args.camera)))
    for group in ("interpolation", "extrapolation"):
        held_out = read_views(args.folder, record, np.intersect1d(splits[group], measured), device)
        figures |= {group: evaluate(model, held_out)}
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
