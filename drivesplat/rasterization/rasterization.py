"""The rasterization call, with gsplat's meaning, whatever stands behind it."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from drivesplat.rasterization.rendering import Rendering

BACKENDS = ("gsplat", "cpu", "reference")


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    colors: Float[Tensor, "n channels"] | Float[Tensor, "n k 3"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    antialiased: bool = False,
    absgrad: bool = False,
    with_depth: bool = False,
    backend: str | None = None,
) -> Rendering:
    """Renders n Gaussians in C pinhole cameras.

    `means` in world metres; `quats` w, x, y, z (normalised inside); `scales` metres; `opacities` in [0, 1]; `colors`
    are SH coefficients up to `sh_degree`, or final values where that is None. `viewmats` take world to camera (OpenCV);
    `Ks` use the continuous pixel convention. The projection is EWA splatting (Zwicker et al. 2001) as in 3D Gaussian
    Splatting (Kerbl et al. 2023); `antialiased` scales opacities by the 2D filter's loss (Yu et al. 2024).

    `backend`: one of BACKENDS; None takes gsplat on a GPU and cpu elsewhere.
    """
    chosen = backend or ("gsplat" if means.is_cuda else "cpu")
    return _backend(chosen)(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height,
        sh_degree=sh_degree, antialiased=antialiased, absgrad=absgrad, with_depth=with_depth,
    )  # fmt: skip


def _backend(name: str) -> Callable[..., Rendering]:
    if name == "gsplat":
        from drivesplat.rasterization.gsplat_backend import rasterize_gsplat

        return rasterize_gsplat
    if name == "cpu":
        from drivesplat.rasterization.cpu import rasterize_cpu

        return rasterize_cpu
    if name == "reference":
        from drivesplat.rasterization.reference import rasterize_reference

        return rasterize_reference
    raise ValueError(f"no rasterizer is called {name!r}: there are {', '.join(BACKENDS)}")
