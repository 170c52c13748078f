"""The actors of a trained model that edits change."""

from collections.abc import Iterable

from drivesplat.edited_motion.edited_actors import EditedActor
from drivesplat.errors import ConfigError, ResultError
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.motion import Motion
from drivesplat.scene.scene import Scene


def editable_actors(model: SplatModel, scene: Scene, where: str) -> list[EditedActor]:
    """The actors of the model, with their motion as trained.

    Messages start with `where`. Raises ConfigError if there are none, ResultError if the scene lacks one of them.
    """
    actors = trained_actors(model, scene, where)
    if not actors:
        raise ConfigError(
            f"{where}: nothing can be edited, since the model of this method has no actors; "
            "train one with the part 'actors' (the method 'street') on a scene with moving vehicles"
        )
    return actors


def trained_actors(model: SplatModel, scene: Scene, where: str) -> list[EditedActor]:
    """As `editable_actors`, without the ConfigError: a model may have none."""
    actors = []
    for name, group in model.rigid_groups(0.0).items():
        track = scene.track(name)
        if group.motion is None:
            continue
        if track is None:
            raise ResultError(
                f"{where}: scene.json has no track {name}, which checkpoint.npz contains; delete that file and rerun"
            )
        actors.append(EditedActor.recorded(track.id, track.category, track.size, group.motion))
    return actors


def other_objects(scene: Scene, actors: Iterable[EditedActor]) -> list[EditedActor]:
    """The annotated objects that are none of `actors`, as recorded: the model has them in its static part."""
    ids = {actor.id for actor in actors}
    others = (track for track in scene.tracks if track.id not in ids)
    return [EditedActor.recorded(t.id, t.category, t.size, Motion.of_track(scene, t)) for t in others]
