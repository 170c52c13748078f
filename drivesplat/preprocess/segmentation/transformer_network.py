"""Networks of the library transformers: those for semantic segmentation, Mask2Former and MaskFormer."""

import json
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.preprocess.segmentation.label_sets import label_set
from drivesplat.preprocess.segmentation.network import IMAGENET_MEAN, IMAGENET_STD, NetworkInput, ScoreNetwork
from drivesplat.preprocess.segmentation.weights import missing_package, weights_digest, weights_files
from drivesplat.settings.segment import LabelSetName

OF_QUERIES = ("mask2former", "maskformer")
"""Architectures that give masks and the labels of masks, not the labels of pixels."""
UNNAMED = "label_"
"""How transformers calls labels without a name, in small letters."""
OF_TRAINING = "auxiliary_head"
"""How the names of layers begin that only a training uses."""
PREPROCESSOR = "preprocessor_config.json"


class TransformerNetwork(ScoreNetwork):
    """The network in a folder of transformers: config.json, weights, preprocessor_config.json."""

    def __init__(self, name: str, folder: Path, device: torch.device, labels: LabelSetName | None, height: int | None):
        """Raises DriveSplatError or ConfigError where transformers is missing, or the folder holds no network for
        semantic segmentation."""
        try:
            from transformers import AutoConfig, AutoModelForSemanticSegmentation, AutoModelForUniversalSegmentation
        except ImportError:
            raise missing_package("transformers") from None
        files = weights_files(folder)
        try:
            config = AutoConfig.from_pretrained(folder, local_files_only=True)
            of_queries = config.model_type in OF_QUERIES
            kind = AutoModelForUniversalSegmentation if of_queries else AutoModelForSemanticSegmentation
            self._model, loading = kind.from_pretrained(folder, local_files_only=True, output_loading_info=True)
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            why = str(error).strip().partition("\n")[0]
            raise ConfigError(
                f"segment.model: {name} cannot be opened as a network that segments images ({why})"
            ) from None
        learned = {key for key, _ in self._model.named_parameters() if not key.startswith(OF_TRAINING)}
        if missing := sorted(learned & set(loading["missing_keys"])):
            raise ConfigError(
                f"segment.model: {name} has no weights of some layers ({missing[0]}), so it was not trained to segment "
                "images; name another"
            )
        self._name, self._of_queries = name, of_queries
        self._model.eval().requires_grad_(False).to(device)
        names = [str(config.id2label[number]) for number in range(config.num_labels)]
        named = None if all(one.lower().startswith(UNNAMED) for one in names) else names
        super().__init__(
            label_set(name, config.num_labels, named, labels),
            network_input(folder, height, getattr(config, "image_size", None)),
            weights_digest(files, height),
            device,
        )

    def scores(self, inputs: Float[Tensor, "n 3 a b"]) -> Float[Tensor, "n c p q"]:
        try:
            found = self._model(pixel_values=inputs)
        except (ValueError, RuntimeError) as error:
            if "CUDA" in str(error):
                raise
            pixels, other = f"{inputs.shape[3]}x{inputs.shape[2]}", "a number" if self.taken.size else "null"
            raise DriveSplatError(
                f"segment.model: {self._name} takes no images of {pixels} pixels; set segment.height to {other}, or "
                "name another model"
            ) from error
        if not self._of_queries:
            return found.logits
        # the last label is that of queries without an object
        of_labels = found.class_queries_logits.softmax(-1)[..., :-1]
        return torch.einsum("nqc,nqhw->nchw", of_labels, found.masks_queries_logits.sigmoid())


def network_input(folder: Path, height: int | None, trained: int | None = None) -> NetworkInput:
    """What a network takes: images of `height` pixels; where that is None, of the size in the preprocessor_config.json
    of its `folder`, else `trained` pixels wide and high, else 512 pixels high. The normalisation is that of the file,
    else ImageNet's. Raises ConfigError where the file is damaged."""
    try:
        stated = json.loads((folder / PREPROCESSOR).read_text(encoding="utf-8"))
    except FileNotFoundError:
        stated = {}
    except (OSError, ValueError) as error:
        raise ConfigError(f"segment.model: {folder / PREPROCESSOR} is damaged ({error})") from None
    mean, std = (tuple(stated.get(key) or usual) for key, usual in NORMALISATION.items())
    if height is not None:
        return NetworkInput(mean, std, None, height)
    size = stated.get("size") or (trained if isinstance(trained, int) else {})
    sides = {"height": size, "width": size} if isinstance(size, int) else size
    if {"height", "width"} <= sides.keys():
        return NetworkInput(mean, std, (sides["width"], sides["height"]))
    return NetworkInput(mean, std, None, sides.get("shortest_edge") or NetworkInput.height)


NORMALISATION = {"image_mean": IMAGENET_MEAN, "image_std": IMAGENET_STD}
"""The values of preprocessor_config.json, and those where it lacks them."""
