"""CUDA C++ kernels compiled for a processor, whose threads take turns: checks their arithmetic without a GPU.

Knows what the sources of `drivesplat.kernels.cuda` use: one dimension of blocks and threads, static shared memory,
barriers, votes and shuffles of full warps, and atomic operations. It does not notice races between threads.
"""

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from torch import Tensor

from drivesplat.kernels.cuda.compiled import Program

COMPILER = shutil.which("c++")

CUDA = r"""
#include <algorithm>
#include <cmath>
#include <functional>
#include <utility>
#include <vector>
#include <ucontext.h>
using std::min; using std::max;
#define __device__
#define __global__
#define __forceinline__ inline
#define __launch_bounds__(threads)
#define __shared__ static
#define __expf expf
#define __logf logf
struct Index { int x; };
static Index blockIdx, threadIdx;

// Threads run in turns, each until it waits for others.
struct Barrier { int threads, arrived = 0, passed = 0; };
static std::vector<ucontext_t> contexts;
static std::vector<char> ended;
static std::vector<Barrier> barriers;  // of the block, then of its warps
static std::vector<float> floats;
static std::vector<int> integers;
static ucontext_t scheduler;
static std::function<void()> kernel;

static void wait_at(Barrier& barrier) {
    int before = barrier.passed;
    if (++barrier.arrived == barrier.threads) { barrier.arrived = 0; ++barrier.passed; }
    while (barrier.passed == before) swapcontext(&contexts[threadIdx.x], &scheduler);
}
static void run_one() { kernel(); ended[threadIdx.x] = 1; }

static void run_block(int threads) {
    contexts.assign(threads, {}); ended.assign(threads, 0); floats.assign(threads, 0); integers.assign(threads, 0);
    barriers.assign(1, {threads}); barriers.resize(1 + threads / 32, {32});
    std::vector<std::vector<char>> stacks(threads, std::vector<char>(1 << 16));
    for (int t = 0; t < threads; ++t) {
        getcontext(&contexts[t]);
        contexts[t].uc_stack.ss_sp = stacks[t].data(); contexts[t].uc_stack.ss_size = stacks[t].size();
        contexts[t].uc_link = &scheduler;
        makecontext(&contexts[t], run_one, 0);
    }
    for (int left = threads; left;)
        for (int t = 0; t < threads; ++t) {
            if (ended[t]) continue;
            threadIdx.x = t;
            swapcontext(&scheduler, &contexts[t]);
            left -= ended[t];
        }
}

static Barrier& own_warp() { return barriers[1 + threadIdx.x / 32]; }
static void __syncthreads() { wait_at(barriers[0]); }
static void __syncwarp() { wait_at(own_warp()); }
static void __threadfence() {}
template <class T> static T __ldcg(const T* at) { return *at; }
static int __syncthreads_and(int value) {
    integers[threadIdx.x] = value; __syncthreads();
    int found = 1;
    for (int given : integers) found = found && given;
    __syncthreads();
    return found;
}
static unsigned __ballot_sync(unsigned, int value) {
    integers[threadIdx.x] = value; wait_at(own_warp());
    unsigned found = 0;
    for (int i = 0; i < 32; ++i) found |= unsigned(integers[threadIdx.x / 32 * 32 + i] != 0) << i;
    wait_at(own_warp());
    return found;
}
static int __all_sync(unsigned lanes, int value) { return __ballot_sync(lanes, value) == 0xffffffffu; }
static int __any_sync(unsigned lanes, int value) { return __ballot_sync(lanes, value) != 0; }
template <class T> static T shuffled(std::vector<T>& slots, T value, int bits) {
    slots[threadIdx.x] = value; wait_at(own_warp());
    T found = slots[threadIdx.x ^ bits]; wait_at(own_warp());
    return found;
}
static float __shfl_xor_sync(unsigned, float value, int bits) { return shuffled(floats, value, bits); }
static int __shfl_xor_sync(unsigned, int value, int bits) { return shuffled(integers, value, bits); }
static int __ffs(unsigned value) { return __builtin_ffs(value); }
static int __clz(unsigned value) { return value ? __builtin_clz(value) : 32; }
static float __fdividef(float a, float b) { return a / b; }
static void atomicAdd(float* at, float value) { *at += value; }
static void atomicMax(int* at, int value) { *at = max(*at, value); }

// Calls a kernel with addresses and integers that stand in an array.
template <class... Kinds, size_t... places>
static void call(void (*kernel)(Kinds...), const long long* given, std::index_sequence<places...>) {
    kernel((Kinds)given[places]...);
}
template <class... Kinds> static void call(void (*kernel)(Kinds...), const long long* given) {
    call(kernel, given, std::index_sequence_for<Kinds...>());
}
"""


def kernels_on_cpu(program: Program, channels: int, length: int, folder: Path) -> dict[str, Callable[..., None]]:
    """The kernels of a program by name, with the arguments of `drivesplat.kernels.cuda.compiled.kernels`, compiled in a
    folder by COMPILER."""
    runs = (_run_function(kernel) for kernel in program.kernels)
    source = "\n".join([CUDA, f"#define CHANNELS {channels}\n#define LENGTH {length}", program.source, *runs])
    file, library = folder / f"{program.name}.cpp", folder / f"{program.name}-{channels}-{length}.so"
    file.write_text(source)
    options = ("-std=c++17", "-O1", "-w", "-shared", "-fPIC")
    subprocess.run([COMPILER, *options, "-o", str(library), str(file)], check=True)
    loaded = ctypes.CDLL(str(library))
    return {kernel: partial(_run, loaded[f"run_{kernel}"]) for kernel in program.kernels}


def _run_function(kernel: str) -> str:
    """C++ that runs all blocks of a kernel."""
    return f"""extern "C" void run_{kernel}(int blocks, int threads, const long long* given) {{
        ::kernel = [=] {{ call({kernel}, given); }};
        for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x) run_block(threads);
    }}"""


def _run(function: Callable[..., None], blocks: int, threads: int, arguments: Sequence[Tensor | int]) -> None:
    values = [given if isinstance(given, int) else given.data_ptr() for given in arguments]
    function(blocks, threads, (ctypes.c_longlong * len(values))(*values))
