"""CUDA C++ that several sources share."""

WARPS = r"""
#define WARP 32
#define EVERY_LANE 0xffffffffu
#define WIDTH (GRADIENTS <= 8 ? 8 : GRADIENTS <= 16 ? 16 : 32)  // the power of two that holds them

// Sums WIDTH values over the lanes of a warp. Lane l returns the sum of value l / (WARP / WIDTH): in each step lanes
// exchange halves of what is left, so that few shuffles serve all values.
template <int HALF>
__device__ __forceinline__ float sum_over_lanes(float (&g)[WIDTH], int lane) {
    constexpr int BIT = HALF * WARP / WIDTH;
    bool upper = lane & BIT;
    #pragma unroll
    for (int i = 0; i < HALF; ++i) {
        float kept = upper ? g[i + HALF] : g[i], given = upper ? g[i] : g[i + HALF];
        g[i] = kept + __shfl_xor_sync(EVERY_LANE, given, BIT);
    }
    if constexpr (HALF > 1) return sum_over_lanes<HALF / 2>(g, lane);
    #pragma unroll
    for (int bit = BIT / 2; bit >= 1; bit /= 2) g[0] += __shfl_xor_sync(EVERY_LANE, g[0], bit);
    return g[0];
}
"""
"""A warp, and sums over its lanes. GRADIENTS, the number of values to sum, has to be defined before it."""
