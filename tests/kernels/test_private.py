"""What the library uses of the private names of torch, gsplat and numba: unchanged, and used in one module each."""

import ast
import inspect
import re
from collections.abc import Callable, Iterator

import pytest
import torch
from gsplat import DefaultStrategy
from gsplat.cuda import _torch_impl
from gsplat.strategy import ops
from helpers import REPOSITORY
from helpers.syntax_trees import source_of, tree_of
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from torch.cuda import _utils

from drivesplat.kernels.mcmc import relocation

LIBRARIES = ("torch", "gsplat", "numba", "triton")
KEPT = ("_version", "_buffers", "_parameters", "_schema")
"""Private names of their objects, whatever these are called."""
MODULES = {"drivesplat/kernels/torch_private.py", "drivesplat/kernels/gsplat_private.py"}
TORCH = {
    "_foreach_add_.Scalar": "(Tensor(a!)[] self, Scalar scalar) -> ()",
    "_foreach_copy_": "(Tensor(a!)[] self, Tensor[] src, bool non_blocking=False) -> ()",
    "_fused_adam_.tensor_lr": "(Tensor(a!)[] self, Tensor(b!)[] grads, Tensor(c!)[] exp_avgs, "
    "Tensor(d!)[] exp_avg_sqs, Tensor(e!)[] max_exp_avg_sqs, Tensor[] state_steps, *, Tensor lr, float beta1, "
    "float beta2, float weight_decay, "
    "float eps, bool amsgrad, bool maximize, Tensor? grad_scale=None, Tensor? found_inf=None) -> ()",
}
GSPLAT = [
    (ops._update_param_with_optimizer, "param_fn optimizer_fn params optimizers names"),
    (ops._multinomial_sample, "weights n replacement"),
    (ops.compute_relocation, "opacities scales ratios binoms"),
    (relocation, "opacities scales ratios binoms"),
    (ops.quat_scale_to_covar_preci, "quats scales compute_covar compute_preci triu"),
    (_torch_impl._quat_scale_to_covar_preci, "quats scales compute_covar compute_preci triu"),
    (_torch_impl._eval_sh_bases_fast, "basis_dim dirs"),
    (DefaultStrategy._grow_gs, "self params optimizers state step"),
]


def test_what_we_use_of_torchs_private_names_is_unchanged():
    advice = "torch has changed it: adapt drivesplat/kernels/torch_private.py"
    for name, schema in TORCH.items():
        operator, _, overload = name.partition(".")
        found = str(getattr(getattr(torch.ops.aten, operator), overload or "default")._schema)
        assert found == f"aten::{name}{schema}" and callable(getattr(torch, operator)), advice
    tensor = torch.zeros(2)
    before = tensor._version
    tensor.add_(1.0)
    assert tensor._version > before, advice
    for name in ("_cuda_endAllocateToPool", "_cuda_releasePool"):
        assert torch.version.cuda is None or hasattr(torch._C, name), advice
    assert list(inspect.signature(_utils._cuda_load_module).parameters) == ["ptx", "kernel_names"], advice
    assert _utils._CudaKernel("function", "module").func == "function" and callable(_utils._get_cuda_library), advice
    assert list(inspect.signature(_utils._check_cuda).parameters) == ["result"], advice


def test_numba_caches_compiled_functions_by_the_class_that_we_replace():
    assert inspect.getsource(Dispatcher.enable_caching).rstrip().endswith("self._cache = FunctionCache(self.py_func)")
    assert list(inspect.signature(FunctionCache.save_overload).parameters) == ["self", "sig", "data"]


@pytest.mark.parametrize(("function", "parameters"), GSPLAT, ids=[function.__name__ for function, _ in GSPLAT])
def test_gsplats_private_functions_are_unchanged(function: Callable, parameters: str):
    found = " ".join(inspect.signature(function).parameters)
    assert found == parameters, "gsplat has changed it: adapt drivesplat/kernels/gsplat_private.py"


def test_gsplat_grows_gaussians_and_its_strategies_call_kernels_where_we_replace_them():
    source = inspect.getsource(DefaultStrategy.step_post_backward)
    assert "self._grow_gs(" in source, "gsplat does not call _grow_gs any more: HookedDefaultStrategy has no effect"
    for caller, called in ((ops.relocate, "compute_relocation("), (ops.sample_add, "compute_relocation(")):
        assert called in inspect.getsource(caller), f"cpu_strategies replaces {called} for {caller.__name__} in vain"


def private_names(tree: ast.AST) -> Iterator[str]:
    """Private names of LIBRARIES that a module imports, or reads from a name that it has imported from them."""
    imported, nodes = set(), [*ast.walk(tree)]
    for node in nodes:
        if isinstance(node, ast.Import):
            imported |= {(a.asname or a.name).partition(".")[0] for a in node.names if a.name.startswith(LIBRARIES)}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in LIBRARIES:
            imported |= {alias.asname or alias.name for alias in node.names}
            paths = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from (path for path in paths if is_private(path))
    for node in nodes:
        if not isinstance(node, ast.Attribute):
            continue
        name = dotted(node)
        if name.partition(".")[0] in imported and is_private(name):
            yield name
        elif node.attr in KEPT:
            yield ast.unparse(node)


def dotted(node: ast.expr) -> str:
    """'torch._C.f' for an attribute of a name; what belongs to any other expression begins with a full stop."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def is_private(path: str) -> bool:
    return any(part.startswith("_") and not part.startswith("__") for part in path.split("."))


def test_private_names_are_used_in_one_module_per_library():
    files = [file for file in (REPOSITORY / "drivesplat").rglob("*.py") if "__pycache__" not in file.parts]
    known = re.compile(rf"\b({'|'.join(LIBRARIES)})\b|\.({'|'.join(KEPT)})\b")
    files = [file for file in files if known.search(source_of(file))]
    uses = {str(file.relative_to(REPOSITORY)): set(private_names(tree_of(file))) for file in files}
    assert {file: names for file, names in uses.items() if names and file not in MODULES} == {}
    assert all(uses[file] for file in MODULES)


def test_private_names_are_found_in_every_form():
    source = "import torch\nfrom gsplat.cuda import _x\nfrom gsplat import ops\ntorch._C.f\nops._y()\nops.z\na._version"
    assert set(private_names(ast.parse(source))) == {"gsplat.cuda._x", "torch._C.f", "torch._C", "ops._y", "a._version"}
