"""The actors of a trained model that edits change."""

from drivesplat.edited_motion.edited_actors import EditedActor
from drivesplat.errors import ConfigError, ResultError
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scene import Scene


def editable_actors(model: SplatModel, scene: Scene, where: str) -> list[EditedActor]:
    """The actors of the model, with their motion as trained.

    Messages start with `where`. Raises ConfigError if there are none, ResultError if the scene lacks one of them.
    """
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
    if not actors:
        raise ConfigError(
            f"{where}: nothing can be edited, since the model of this method has no actors; "
            "train one with the part 'actors' (the method 'street') on a scene with moving vehicles"
        )
    return actors
