"""Scores of a run in the closed loop, as values at each step and as a summary of plain data.

docs/closed_loop.md lists each with its formula, its unit, its source and the step from which it holds. Nothing before
`DrivenRun.loop_from` counts. What is not known is None, never 0.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from drivesplat.errors import RequestError
from drivesplat.simulate.comfort import comfort_columns, comfort_extremes
from drivesplat.simulate.contacts import SIDES, Contact, Encounters, contact_sides, contacts, counted, threatened
from drivesplat.simulate.driven_run import DrivenRun
from drivesplat.trajectories.reference_path import PathPlaces, ReferencePath

HALF_LANE = 1.75
"""Metres from the recorded path beyond which a corner of the ego vehicle is in another lane."""
MIN_PROGRESS = 5.0
"""Metres of the recorded path up to which standing still is no lack of progress (NAVSIM, AlpaSim)."""
MIN_RECORDED = 1.0
"""Metres of recorded progress below which ratios to it are not known."""
CORRIDOR = 4.0
"""Metres from the recorded path beyond which AlpaSim drops the rest of a run."""
FULL_PROGRESS = 0.8
"""Share of the recorded progress for which AlpaSim gives the full score."""
FULL_ROUTE = 0.9
"""Share of the recorded path at which HUGSIM calls a route complete."""
ONCOMING_S, ONCOMING_M = 1.0, (2.0, 6.0)
"""Seconds over which metres against the direction are counted, and how many cost half and all (NAVSIM)."""
SUBSCORES = ("nc", "dac", "ttc", "ep", "c", "ddc", "rc", "offroad")
"""Parts of scores that may be unknown."""

Column = Float64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class RunScores:
    """Scores of a run of n steps.

    `columns` holds values at each step, float64 (n,): yes and no are 1 and 0, NaN stands where a score does not hold,
    inf in `ttc_s` for never; a column is None where its input is missing. `contacts` are those of the ego vehicle, with
    the run's steps. `summary` is plain data for JSON, in which null is not known.
    """

    columns: Mapping[str, Column | None]
    contacts: Sequence[Contact]
    summary: Mapping[str, Any]


def run_scores(run: DrivenRun, ttc_horizon: float = 1.0, ttc_max: float = 5.0) -> RunScores:
    """The scores of a run.

    `ttc_ok` asks for contacts within `ttc_horizon` seconds; `ttc_s` is inf beyond `ttc_max` seconds. Raises
    RequestError where the policy drives at no step.

        scores = run_scores(run)
        scores.summary["pdms"], scores.columns["ttc_s"].min()
    """
    if not 0 <= run.loop_from < len(run):
        raise RequestError(
            f"the policy drives at no step of this run: loop_from is {run.loop_from} of {len(run)} steps"
        )
    part, path = run.from_loop(), ReferencePath(run.recorded, run.recorded_seconds)
    around = Encounters.of(part)
    places = path.track(part.ego_to_world[:, :2, 3], path.begin(float(part.seconds[0])))
    off, off_at_start = _off_drivable(part, around)

    def lane_left(asked: np.ndarray) -> np.ndarray:
        left = np.zeros(len(asked), dtype=bool)
        far = path.distances(around.ego.corners[asked], places.arc[asked]) > HALF_LANE
        left[asked] = far.any(axis=1) if off is None else far.any(axis=1) | (off[asked] == 1.0)
        return left

    found = contacts(around, lane_left)
    columns = {
        **_contact_columns(around, found),
        "ttc_s": _time_to_collision(around, found, ttc_max),
        "ttc_ok": 1.0 - threatened(around, found, ttc_horizon, lane_left),
        "off_drivable": off,
        **_path_columns(part, path, places),
        **comfort_columns(part.seconds, part.ego_to_world, part.speed),
    }
    columns["hugsim_pdms"] = _pdms_of_steps(columns, found)
    summary = _summary(part, path, places, columns, found) | {"off_drivable_at_start": off_at_start}
    return RunScores(*_in_steps_of(run, columns, found, summary))


def _off_drivable(part: DrivenRun, around: Encounters) -> tuple[Column | None, bool | None]:
    """Whether a corner of the ego vehicle is off the drivable area at each step, and whether one is at the first step.

    Steps before the ego vehicle is on it for the first time do not hold (NaN): the map is wrong, or it began off the
    area. None where there is no map, or it is never on it.
    """
    if part.drivable is None:
        return None, None
    on = part.drivable(around.ego.corners.reshape(-1, 2)).reshape(-1, 4).all(axis=1)
    if not on.any():
        return None, True
    off = np.where(on, 0.0, 1.0)
    off[: int(np.argmax(on))] = np.nan
    return off, not on[0]


def _contact_columns(around: Encounters, found: Sequence[Contact]) -> dict[str, Column]:
    """AlpaSim's contacts at each step, and NAVSIM's that are at fault."""
    holds = counted(around, found)
    columns = {"collision_any": around.touching & holds}
    columns |= {f"collision_{name}": touched & holds for name, touched in contact_sides(around).items()}
    at_fault = np.zeros(len(around.run))
    for contact in found:
        if contact.counts and contact.at_fault:
            at_fault[contact.first_step : contact.last_step + 1] = 1.0
    return {name: touched.any(axis=0).astype(float) for name, touched in columns.items()} | {
        "at_fault_collision": at_fault
    }


def _time_to_collision(around: Encounters, found: Sequence[Contact], ttc_max: float) -> Column:
    """Seconds until the first object is touched if all velocities and headings stay."""
    times = np.where(counted(around, found), around.ttc, np.inf).min(axis=0, initial=np.inf)
    return np.where(times <= ttc_max, times, np.inf)


def _path_columns(part: DrivenRun, path: ReferencePath, places: PathPlaces) -> dict[str, Column]:
    """The distance driven, and where the ego vehicle is beside the recorded path and the recorded vehicle."""
    here = part.ego_to_world[:, :2, 3]
    moved = np.diff(here, axis=0)
    progress = places.arc - places.arc[0]
    recorded = path.arcs_at(part.seconds) - path.begin(float(part.seconds[0]))
    ratio = np.where(recorded >= MIN_RECORDED, progress / np.maximum(recorded, MIN_RECORDED), np.nan)
    clipped = np.where(recorded < MIN_RECORDED, 1.0, np.clip(ratio, 0.0, 1.0))
    against = np.cumsum(np.concatenate([[0.0], np.maximum(-(moved * places.tangent[1:]).sum(axis=1), 0.0)]))
    oncoming = against - np.interp(part.seconds - ONCOMING_S, part.seconds, against)
    return {
        "distance_m": np.concatenate([[0.0], np.cumsum(np.linalg.norm(moved, axis=1))]),
        "progress_m": progress,
        "recorded_progress_m": recorded,
        "progress_ratio": ratio,
        "progress_rel": clipped,
        "path_offset_m": places.offset,
        "dist_to_gt_trajectory": path.distances_with_ends(here, places),
        "dist_to_gt_location": np.linalg.norm(here - path.places_at(part.seconds), axis=1),
        "oncoming_m": oncoming,
        "driving_direction": np.select([oncoming < ONCOMING_M[0], oncoming < ONCOMING_M[1]], [1.0, 0.5], 0.0),
    }


def _pdms_of_steps(columns: Mapping[str, Column | None], found: Sequence[Contact]) -> Column:
    """HUGSIM's PDMS at each step, of the driven path: NC · DAC · (5 TTC + 2 C) / 7, without what is not known."""
    score = np.ones(len(columns["ttc_ok"]))
    for contact in found:
        part = slice(contact.first_step, contact.last_step + 1)
        score[part] = np.minimum(score[part], contact.score)
    if columns["off_drivable"] is not None:
        score = np.where(columns["off_drivable"] == 1.0, 0.0, score)
    comfortable = columns["comfortable"]
    with_comfort = (5.0 * columns["ttc_ok"] + 2.0 * comfortable) / 7.0
    return score * np.where(np.isnan(comfortable), columns["ttc_ok"], with_comfort)


def pdm_score(factors: Sequence[float | None], weighted: Sequence[tuple[float, float | None]]) -> float:
    """NAVSIM's form: the product of `factors` times the mean of (weight, value) pairs, without those that are None."""
    known = [(weight, value) for weight, value in weighted if value is not None]
    mean = sum(weight * value for weight, value in known) / sum(weight for weight, _ in known)
    return math.prod(factor for factor in factors if factor is not None) * mean


def _summary(
    part: DrivenRun,
    path: ReferencePath,
    places: PathPlaces,
    columns: Mapping[str, Column],
    found: Sequence[Contact],
) -> dict[str, Any]:
    counting = [contact for contact in found if contact.counts]
    subscores = _subscores(columns, counting)
    hugsim = float(columns["hugsim_pdms"].mean())
    rest = path.length - places.arc[0]
    subscores["rc"] = _clip(places.arc[-1] - places.arc[0], FULL_ROUTE * rest) if rest >= MIN_PROGRESS else None
    alpasim = _alpasim(columns)
    nc, dac, ttc, ep, c = (subscores[name] for name in ("nc", "dac", "ttc", "ep", "c"))
    nearest = np.linalg.norm(part.recorded[:, :2, 3] - part.ego_to_world[-1, :2, 3], axis=1).argmin()
    return {
        "steps": len(part),
        "duration_s": float(part.seconds[-1] - part.seconds[0]),
        "distance_m": float(columns["distance_m"][-1]),
        "first_incident": _first_incident(part, columns, counting),
        "collisions": len(counting),
        "at_fault_collisions": sum(contact.at_fault for contact in counting),
        "collision_any": bool(counting),
        **{f"collision_{side}": side in {contact.side for contact in counting} for side in SIDES},
        **subscores,
        "min_ttc_s": _known(columns["ttc_s"].min()),
        "progress_m": float(columns["progress_m"][-1]),
        "recorded_progress_m": _last_known(columns["recorded_progress_m"]),
        "progress_ratio": _last_known(columns["progress_ratio"]),
        "progress_rel": _reduced(np.min, columns["progress_rel"]),
        "max_path_offset_m": float(np.abs(columns["path_offset_m"]).max()),
        "mean_path_offset_m": float(np.abs(columns["path_offset_m"]).mean()),
        "dist_to_gt_trajectory": float(columns["dist_to_gt_trajectory"].max()),
        "dist_to_gt_location": _reduced(np.max, columns["dist_to_gt_location"]),
        "ade_m": _reduced(np.mean, columns["dist_to_gt_location"]),
        "comfort": comfort_extremes(columns),
        "pdms": pdm_score([nc, dac], [(5.0, ttc), (5.0, ep), (2.0, c)]),
        "hugsim_pdms": hugsim,
        "hd_score": hugsim if subscores["rc"] is None else hugsim * subscores["rc"],
        "hugsim_rc": float((nearest + 1) / (FULL_ROUTE * len(part.recorded))),
        **alpasim,
        "not_known": [name for name in SUBSCORES if subscores.get(name, alpasim.get(name)) is None],
    }


def _subscores(columns: Mapping[str, Column | None], counting: Sequence[Contact]) -> dict[str, float | None]:
    """NAVSIM's subscores of the whole run: each is the worst of all steps, and `ep` that of the last step at which the
    recorded progress is known."""
    off, comfortable = columns["off_drivable"], columns["comfortable"]
    recorded, ep = _last_known(columns["recorded_progress_m"]), None
    if recorded is not None:
        progress = columns["progress_m"][~np.isnan(columns["recorded_progress_m"])][-1]
        further = max(progress, recorded)
        ep = 1.0 if further <= MIN_PROGRESS else _clip(progress, further)
    return {
        "nc": min((contact.score for contact in counting), default=1.0),
        "dac": None if off is None else 1.0 - float(np.nanmax(off)),
        "ttc": float(columns["ttc_ok"].min()),
        "ep": ep,
        "c": None if np.isnan(comfortable).all() else float(np.nanmin(comfortable)),
        "ddc": float(columns["driving_direction"].min()),
    }


def _alpasim(columns: Mapping[str, Column | None]) -> dict[str, float | bool | None]:
    """AlpaSim's score of a scene and its parts, of the steps up to the first incident, that step included."""
    off = columns["off_drivable"]
    ends = (columns["collision_any"] == 1.0) | (columns["dist_to_gt_trajectory"] >= CORRIDOR)
    if off is not None:
        ends |= off == 1.0
    kept = slice(0, int(np.argmax(ends)) + 1 if ends.any() else None)
    reachable, progress = _last_known(columns["recorded_progress_m"]), float(columns["progress_m"][kept][-1])
    at_fault = bool((columns["collision_front"][kept] + columns["collision_lateral"][kept]).any())
    offroad = None if off is None else bool((off[kept] == 1.0).any())
    relative = score = None
    if reachable is not None:
        relative = 1.0 if reachable < MIN_RECORDED else _clip(progress, reachable)
        score = 1.0 if reachable < MIN_PROGRESS else min(relative / FULL_PROGRESS, 1.0)
        score = 0.0 if at_fault or offroad else score
    return {
        "alpasim_score": score,
        "collision_at_fault": at_fault,
        "offroad": offroad,
        "progress_clipped_rel": relative,
        "left_corridor_laterally": bool((np.abs(columns["path_offset_m"][kept]) >= CORRIDOR).any()),
        "alpasim_steps": len(columns["progress_m"][kept]),
    }


def _first_incident(
    part: DrivenRun, columns: Mapping[str, Column | None], counting: Sequence[Contact]
) -> dict[str, Any] | None:
    """The first contact or the first step off the drivable area."""
    found = [
        {"kind": f"collision_{c.side}", "step": c.first_step, "object": c.object_id, "at_fault": c.at_fault}
        for c in counting
    ]
    if columns["off_drivable"] is not None and (columns["off_drivable"] == 1.0).any():
        step = int(np.argmax(columns["off_drivable"] == 1.0))
        found.append({"kind": "off_drivable", "step": step, "object": None, "at_fault": True})
    first = min(found, key=lambda incident: incident["step"], default=None)
    return first and first | {"second": float(part.seconds[first["step"]])}


def _in_steps_of(
    run: DrivenRun, columns: Mapping[str, np.ndarray | None], found: Sequence[Contact], summary: dict[str, Any]
) -> tuple[dict[str, np.ndarray | None], list[Contact], dict[str, Any]]:
    """Columns, contacts and summary of the steps that count, with the steps of the whole run."""
    first = run.loop_from
    before = np.full(first, np.nan)
    whole = {name: None if column is None else np.concatenate([before, column]) for name, column in columns.items()}
    moved = [replace(c, first_step=c.first_step + first, last_step=c.last_step + first) for c in found]
    incident = summary["first_incident"]
    incident = incident and incident | {"step": incident["step"] + first}
    rows = [{name: value for name, value in asdict(contact).items() if name != "row"} for contact in moved]
    rows = [row | {"object_class": str(row["object_class"]), "kind": str(row["kind"])} for row in rows]
    return whole, moved, {"loop_from": first, **summary, "first_incident": incident, "contacts": rows}


def _clip(part: float, whole: float) -> float:
    return float(np.clip(part / whole, 0.0, 1.0))


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _last_known(values: Column) -> float | None:
    known = values[~np.isnan(values)]
    return float(known[-1]) if len(known) else None


def _reduced(reduce: Any, values: Column) -> float | None:
    known = values[~np.isnan(values)]
    return float(reduce(known)) if len(known) else None
