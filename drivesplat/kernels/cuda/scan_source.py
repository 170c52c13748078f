"""The CUDA C++ source of the kernels that composite chunks of a LiDAR scan's lists (`drivesplat.kernels.cuda.scans`).

A warp has a chunk: a lane is a ray of its tile, and loads one of each 32 Gaussians for all lanes. CHANNELS, the number
of values of a Gaussian, and LENGTH, the maximum number of entries of a chunk, are defined when it is compiled. All
formulas are those of `scan_chunks`, `scan_sums` and `scan_gradients` in `drivesplat.kernels.triton`.
"""

from drivesplat.kernels.cuda.warps import WARPS
from drivesplat.kernels.scan_borders import ON_GPU
from drivesplat.kernels.scan_chunks import MAX_ALPHA, MIN_TRANSMITTANCE, NOTHING, RAYS
from drivesplat.kernels.scanned_gaussians import MIN_ALPHA

KERNELS = ("scan_transmittances", "scan_sums", "scan_gradients")

WARPS_PER_BLOCK = 4

if RAYS != 32:
    raise ValueError("a lane of a warp is a ray of a tile")

SOURCE = (
    f"""
#define GRADIENTS (CHANNELS + 9)            // of a Gaussian: values, mean, conic, slopes, opacity, range
#define BEAMS {ON_GPU.beams}
#define FIRINGS {ON_GPU.firings}
#define MIN_ALPHA {MIN_ALPHA!r}f
#define MAX_ALPHA {MAX_ALPHA!r}f
#define MIN_TRANSMITTANCE {MIN_TRANSMITTANCE!r}f
#define NOTHING {NOTHING!r}f
#define WARPS_PER_BLOCK {WARPS_PER_BLOCK}
{WARPS}"""
    + r"""
#define PI 3.14159265358979f
#define RAY_SUMS (CHANNELS + 3)             // sums of a ray: range, alpha, alpha before `until`, values

struct Gaussians {
    const float *means2d, *ranges, *conics, *slopes, *limits, *opacities, *values;
};

struct Lists {
    const int* ids;
    const long long* order;
    const int *offsets, *firsts, *tile_of;
    int tiles;
};

struct Rays {
    const int* numbers;
    const float *azimuths, *elevations;
    int beams, firings, across;
};

struct Batch {                              // in shared memory: a Gaussian for each lane of a warp
    float azimuth[WARP], elevation[WARP], a[WARP], b[WARP], c[WARP], opacity[WARP];
    float range[WARP], slope_a[WARP], slope_e[WARP], limit[WARP];
    float values[WARP][CHANNELS > 0 ? CHANNELS : 1];
    int id[WARP];
};

// The chunk of a warp, and the ray of this lane.
struct Chunk {
    int number, start, end, lane;
    long long ray;
    float azimuth, elevation;
    bool exists, inside;

    __device__ Chunk(const Lists& lists, const Rays& rays) {
        number = blockIdx.x * WARPS_PER_BLOCK + threadIdx.x / WARP;
        lane = threadIdx.x % WARP;
        exists = number < lists.firsts[lists.tiles];
        if (!exists) return;
        int tile = lists.tile_of[number], of_scan = rays.numbers[tile];
        start = lists.offsets[tile] + (number - lists.firsts[tile]) * LENGTH;
        end = min(start + LENGTH, lists.offsets[tile + 1]);
        int beam = of_scan / rays.across * BEAMS + lane / FIRINGS;
        int firing = of_scan % rays.across * FIRINGS + lane % FIRINGS;
        inside = beam < rays.beams && firing < rays.firings;
        ray = (long long)beam * rays.firings + firing;
        azimuth = inside ? rays.azimuths[ray] : 0.0f;
        elevation = inside ? rays.elevations[ray] : 0.0f;
    }

    // The place of this lane in an array of a value for each ray of each chunk.
    __device__ long long place() const {
        return (long long)number * WARP + lane;
    }
};

// Loads the Gaussians of the entries from `first` on, and returns how many there are.
template <bool COMPLETE>
__device__ __forceinline__ int load(
    Batch& batch, const Gaussians& g, const Lists& lists, const Chunk& chunk, int first
) {
    int lane = chunk.lane, entry = first + lane;
    __syncwarp();
    if (entry < chunk.end) {
        int id = lists.ids[lists.order[entry]];
        long long i = id;
        batch.azimuth[lane] = g.means2d[2 * i];
        batch.elevation[lane] = g.means2d[2 * i + 1];
        batch.a[lane] = g.conics[3 * i];
        batch.b[lane] = g.conics[3 * i + 1];
        batch.c[lane] = g.conics[3 * i + 2];
        batch.opacity[lane] = g.opacities[i];
        if constexpr (COMPLETE) {
            batch.id[lane] = id;
            batch.range[lane] = g.ranges[i];
            batch.slope_a[lane] = g.slopes[2 * i];
            batch.slope_e[lane] = g.slopes[2 * i + 1];
            batch.limit[lane] = g.limits[i];
            #pragma unroll
            for (int k = 0; k < CHANNELS; ++k) batch.values[lane][k] = g.values[CHANNELS * i + k];
        }
    }
    __syncwarp();
    return min(WARP, chunk.end - first);
}

// Gaussian j where this lane's ray passes it: the offset of the ray, and alpha before it is limited, 0 below MIN_ALPHA.
struct Pass {
    float da, de, raw;

    __device__ __forceinline__ Pass(const Batch& batch, const Chunk& chunk, int j) {
        da = chunk.azimuth - batch.azimuth[j];
        da = da > PI ? da - 2.0f * PI : da;
        da = da < -PI ? da + 2.0f * PI : da;
        de = chunk.elevation - batch.elevation[j];
        float exponent = -(0.5f * batch.a[j] * da + batch.b[j] * de) * da - 0.5f * batch.c[j] * de * de;
        raw = batch.opacity[j] * __expf(fminf(exponent, 0.0f));
        raw = exponent <= 0.0f && raw >= MIN_ALPHA ? raw : 0.0f;
    }

    __device__ __forceinline__ float alpha() const {
        return fminf(raw, MAX_ALPHA);
    }

    // The range at which the ray meets it, and whether this is not limited.
    __device__ __forceinline__ float range(const Batch& batch, int j, bool& free) const {
        float correction = batch.slope_a[j] * da + batch.slope_e[j] * de, limit = batch.limit[j];
        free = fabsf(correction) <= limit;
        return batch.range[j] + fmaxf(fminf(correction, limit), -limit);
    }
};

#define PARAMETERS                                                                                                    \
    const float *means2d, const float *ranges, const float *conics, const float *slopes, const float *limits,         \
    const float *opacities, const float *values, const int *ids, const long long *order, const int *offsets,          \
    const int *firsts, const int *tile_of, const int *numbers, const float *azimuths, const float *elevations,        \
    const float *until
#define SIZES int tiles, int beams, int firings, int across
#define BEGIN                                                                                                         \
    __shared__ Batch batches[WARPS_PER_BLOCK];                                                                        \
    Batch& batch = batches[threadIdx.x / WARP];                                                                       \
    Gaussians g = {means2d, ranges, conics, slopes, limits, opacities, values};                                       \
    Lists lists = {ids, order, offsets, firsts, tile_of, tiles};                                                      \
    Rays rays = {numbers, azimuths, elevations, beams, firings, across};                                              \
    Chunk chunk(lists, rays);                                                                                         \
    if (!chunk.exists) return;

// Writes the transmittance of each chunk.
extern "C" __global__ void __launch_bounds__(WARP * WARPS_PER_BLOCK) scan_transmittances(
    PARAMETERS, float* passes, SIZES
) {
    BEGIN
    float left = chunk.inside ? 1.0f : 0.0f;
    for (int first = chunk.start; first < chunk.end; first += WARP) {
        if (!__any_sync(EVERY_LANE, left > NOTHING)) break;
        int count = load<false>(batch, g, lists, chunk, first);
        for (int j = 0; j < count; ++j) left *= 1.0f - Pass(batch, chunk, j).alpha();
    }
    passes[chunk.place()] = fmaxf(left, NOTHING);
}

// Writes the sums of each chunk, and the median range where it lies in the chunk, by the transmittance in front of it.
extern "C" __global__ void __launch_bounds__(WARP * WARPS_PER_BLOCK) scan_sums(
    PARAMETERS, const float* passes, float* sums, float* middles, SIZES
) {
    BEGIN
    float left = chunk.inside ? passes[chunk.place()] : 0.0f, border = chunk.inside ? until[chunk.ray] : 0.0f;
    float total[RAY_SUMS] = {}, middle = 0.0f;
    for (int first = chunk.start; first < chunk.end; first += WARP) {
        if (!__any_sync(EVERY_LANE, left > MIN_TRANSMITTANCE)) break;
        int count = load<true>(batch, g, lists, chunk, first);
        for (int j = 0; j < count; ++j) {
            Pass pass(batch, chunk, j);
            if (pass.raw == 0.0f) continue;
            bool free;
            float alpha = pass.alpha(), range = pass.range(batch, j, free), after = left * (1.0f - alpha);
            float weight = after > MIN_TRANSMITTANCE ? alpha * left : 0.0f;
            total[0] += weight * range;
            total[1] += weight;
            total[2] += range < border ? weight : 0.0f;
            #pragma unroll
            for (int k = 0; k < CHANNELS; ++k) total[3 + k] += weight * batch.values[j][k];
            if (left > 0.5f && after <= 0.5f) middle += range;
            left = after;
        }
    }
    #pragma unroll
    for (int k = 0; k < RAY_SUMS; ++k) sums[((long long)chunk.number * RAY_SUMS + k) * WARP + chunk.lane] = total[k];
    middles[chunk.place()] = middle;
}

// Adds the gradients of all Gaussians, given those of the sums of each ray; `rests` are the remaining sums in front of
// each chunk.
extern "C" __global__ void __launch_bounds__(WARP * WARPS_PER_BLOCK) scan_gradients(
    PARAMETERS, const float* passes, const float* rests, const float* v_range_sum, const float* v_alpha,
    const float* v_before, const float* v_out, float* v_means2d, float* v_ranges, float* v_conics, float* v_slopes,
    float* v_opacities, float* v_values, SIZES
) {
    BEGIN
    long long ray = chunk.ray;
    bool inside = chunk.inside;
    float left = inside ? passes[chunk.place()] : 0.0f, rest = rests[chunk.place()];
    float border = inside ? until[ray] : 0.0f, by_range = inside ? v_range_sum[ray] : 0.0f;
    float by_alpha = inside ? v_alpha[ray] : 0.0f, by_nearer = inside ? v_before[ray] : 0.0f;
    float by_value[CHANNELS > 0 ? CHANNELS : 1];
    #pragma unroll
    for (int k = 0; k < CHANNELS; ++k) by_value[k] = inside ? v_out[CHANNELS * ray + k] : 0.0f;
    // where this lane adds its sum
    const int each = WARP / WIDTH, sum = chunk.lane / each, own = sum - CHANNELS;
    float* target = own < 0 ? v_values + sum
        : own < 2 ? v_means2d + own
        : own < 5 ? v_conics + (own - 2)
        : own < 7 ? v_slopes + (own - 5)
        : own < 8 ? v_opacities : v_ranges;
    int stride = own < 0 ? CHANNELS : own < 2 ? 2 : own < 5 ? 3 : own < 7 ? 2 : 1;
    bool adds = chunk.lane % each == 0 && sum < GRADIENTS;
    for (int first = chunk.start; first < chunk.end; first += WARP) {
        if (!__any_sync(EVERY_LANE, left > MIN_TRANSMITTANCE)) break;
        int count = load<true>(batch, g, lists, chunk, first);
        for (int j = 0; j < count; ++j) {
            Pass pass(batch, chunk, j);
            float alpha = pass.alpha(), after = left * (1.0f - alpha);
            bool continues = after > MIN_TRANSMITTANCE && alpha > 0.0f;
            if (!__any_sync(EVERY_LANE, continues)) {
                left = after;
                continue;
            }
            bool free;
            float range = pass.range(batch, j, free), weight = continues ? alpha * left : 0.0f;
            float value = by_alpha + (range < border ? by_nearer : 0.0f) + range * by_range, sums[WIDTH] = {};
            #pragma unroll
            for (int k = 0; k < CHANNELS; ++k) {
                value += batch.values[j][k] * by_value[k];
                sums[k] = weight * by_value[k];
            }
            rest -= weight * value;
            bool reached = continues && pass.raw <= MAX_ALPHA;
            float v = reached ? pass.raw * (left * value - __fdividef(rest, 1.0f - alpha)) : 0.0f;
            float of_range = weight * by_range, unlimited = free ? of_range : 0.0f;
            float along_a = v * pass.da, along_e = v * pass.de;
            sums[CHANNELS] = batch.a[j] * along_a + batch.b[j] * along_e - batch.slope_a[j] * unlimited;
            sums[CHANNELS + 1] = batch.b[j] * along_a + batch.c[j] * along_e - batch.slope_e[j] * unlimited;
            sums[CHANNELS + 2] = -0.5f * along_a * pass.da;
            sums[CHANNELS + 3] = -along_a * pass.de;
            sums[CHANNELS + 4] = -0.5f * along_e * pass.de;
            sums[CHANNELS + 5] = unlimited * pass.da;
            sums[CHANNELS + 6] = unlimited * pass.de;
            sums[CHANNELS + 7] = __fdividef(v, fmaxf(batch.opacity[j], NOTHING));
            sums[CHANNELS + 8] = of_range;
            left = after;
            float total = sum_over_lanes<WIDTH / 2>(sums, chunk.lane);
            if (adds && total != 0.0f) atomicAdd(target + (long long)stride * batch.id[j], total);
        }
    }
}
"""
)
