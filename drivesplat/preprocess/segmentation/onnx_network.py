"""Networks in the format ONNX, run by onnxruntime."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.errors import ConfigError
from drivesplat.preprocess.segmentation.label_sets import label_set
from drivesplat.preprocess.segmentation.network import NetworkInput, ScoreNetwork
from drivesplat.preprocess.segmentation.weights import missing_package, weights_digest, weights_files
from drivesplat.settings.segment import LabelSetName


class OnnxNetwork(ScoreNetwork):
    """The network in an .onnx file: one input (n, 3, h, w) float32, RGB normalised as for ImageNet; the first output
    (n, labels, h', w') scores. A fixed size of the input is kept, a fixed number of images, too. On a GPU where
    onnxruntime has its provider."""

    def __init__(self, path: Path, device: torch.device, labels: LabelSetName | None, height: int | None):
        """Raises DriveSplatError or ConfigError where onnxruntime is missing, or the file is no such network."""
        try:
            import onnxruntime
        except ImportError:
            raise missing_package("onnxruntime") from None
        (file,) = weights_files(path)
        wanted = ["CUDAExecutionProvider"] if device.type == "cuda" else []
        providers = [
            name for name in (*wanted, "CPUExecutionProvider") if name in onnxruntime.get_available_providers()
        ]
        try:
            self._session = onnxruntime.InferenceSession(str(file), providers=providers)
        except Exception as error:  # its exceptions share no base class
            why = str(error).strip().partition("\n")[0]
            raise ConfigError(f"segment.model: {path} cannot be opened by onnxruntime ({why})") from None
        inputs, output = self._session.get_inputs(), self._session.get_outputs()[0]
        shape = inputs[0].shape if len(inputs) == 1 else []
        if len(shape) != 4 or shape[1] != 3 or len(output.shape) != 4 or not isinstance(output.shape[1], int):
            raise ConfigError(
                f"segment.model: {path} must have one input (n, 3, height, width), and scores (n, labels, height, "
                "width) as its first output"
            )
        fixed = (shape[3], shape[2]) if isinstance(shape[3], int) and isinstance(shape[2], int) else None
        taken = NetworkInput(size=fixed) if height is None else NetworkInput(size=fixed, height=height)
        self._input_name, self._output_name, self._one = inputs[0].name, output.name, shape[0] == 1
        known = label_set(str(path), output.shape[1], None, labels)
        super().__init__(known, taken, weights_digest([file], height), device)

    def scores(self, inputs: Float[Tensor, "n 3 a b"]) -> Float[Tensor, "n c p q"]:
        arrays = inputs.cpu().numpy()
        parts = [arrays[i : i + 1] for i in range(len(arrays))] if self._one else [arrays]
        found = [self._session.run([self._output_name], {self._input_name: part})[0] for part in parts]
        return torch.cat([torch.from_numpy(scores) for scores in found]).to(self.device)
