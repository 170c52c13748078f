"""Segmentation networks small enough for tests: of transformers, and as ONNX files written byte by byte."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

BACKBONE = {"depths": [1, 1, 1, 1], "hidden_sizes": [4, 8, 8, 8]}
STAGES = ["stage1", "stage2", "stage3", "stage4"]


def save_upernet(folder: Path, labels: Sequence[str] | int, seed: int = 0) -> Path:
    """Saves a UperNet on ConvNeXt, the architecture of the default, with random weights and these labels, or so many
    without names."""
    from transformers import ConvNextConfig, UperNetConfig, UperNetForSemanticSegmentation

    names = {"num_labels": labels} if isinstance(labels, int) else {"id2label": dict(enumerate(labels))}
    sizes = {"hidden_size": 8, "auxiliary_channels": 4, "auxiliary_in_channels": 8}
    config = UperNetConfig(backbone_config=ConvNextConfig(**BACKBONE, out_features=STAGES), **sizes, **names)
    torch.manual_seed(seed)
    UperNetForSemanticSegmentation(config).save_pretrained(folder)
    return folder


def save_mask2former(folder: Path, labels: Sequence[str]) -> Path:
    """The same of a Mask2Former on Swin."""
    from transformers import Mask2FormerConfig, Mask2FormerForUniversalSegmentation, SwinConfig

    backbone = SwinConfig(
        image_size=64, embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 1, 1], window_size=2, out_features=STAGES
    )
    config = Mask2FormerConfig(
        backbone_config=backbone, feature_size=32, mask_feature_size=32, hidden_dim=32, encoder_feedforward_dim=8,
        dim_feedforward=8, encoder_layers=1, decoder_layers=2, num_attention_heads=1, num_queries=5,
        id2label=dict(enumerate(labels)),
    )  # fmt: skip
    torch.manual_seed(0)
    Mask2FormerForUniversalSegmentation(config).save_pretrained(folder)
    return folder


def save_onnx(path: Path, weights: np.ndarray, size: tuple[int, int] | None = None, batch: int | None = None) -> Path:
    """Writes a network of one 1x1 convolution: scores of labels (c) by `weights` (c, 3) from normalised colours. The
    size of its input (width, height) and the number of images are fixed where given."""
    count = len(weights)
    sides = ("h", "w") if size is None else (size[1], size[0])
    tensor = b"".join(_number(1, side) for side in (count, 3, 1, 1)) + _number(2, 1) + _text(8, "weights")
    tensor += _bytes(9, weights.astype("<f4").tobytes())
    node = _text(1, "images") + _text(1, "weights") + _text(2, "scores") + _text(4, "Conv")
    graph = _bytes(1, node) + _text(2, "graph") + _bytes(5, tensor)
    graph += _bytes(11, _value("images", (batch or "n", 3, *sides)))
    graph += _bytes(12, _value("scores", (batch or "n", count, *sides)))
    path.write_bytes(_number(1, 8) + _bytes(8, _text(1, "") + _number(2, 13)) + _bytes(7, graph))
    return path


def _value(name: str, shape: Sequence[int | str]) -> bytes:
    """A ValueInfoProto of float32."""
    sides = b"".join(_bytes(1, _number(1, n) if isinstance(n, int) else _text(2, n)) for n in shape)
    return _text(1, name) + _bytes(2, _bytes(1, _number(1, 1) + _bytes(2, sides)))


def _varint(value: int) -> bytes:
    groups = []
    while value > 127:
        groups.append(value & 127 | 128)
        value >>= 7
    return bytes([*groups, value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _text(field: int, text: str) -> bytes:
    return _bytes(field, text.encode())
