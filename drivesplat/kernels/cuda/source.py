"""The CUDA C++ source of the kernels that composite chunks of tiles' lists (`drivesplat.kernels.cuda.compositing`).

CHANNELS, the number of values of a Gaussian, and LENGTH, the maximum number of entries of a chunk, are defined when it
is compiled. Rays end and contributions are skipped as in gsplat's kernels. With OBJECTS, Gaussians first_object to
end_object - 1 are also composited alone, to a transmittance: `object_transmittances`.
"""

from drivesplat.kernels.cuda.tiles import TILES
from drivesplat.kernels.cuda.warps import WARPS

KERNELS = ("composite_chunks", "composite_chunks_backward")

SOURCE = (
    f"""
#ifndef OBJECTS
#define OBJECTS 0
#endif
#define GRADIENTS (CHANNELS + 6)            // of a Gaussian: values, mean, conic, opacity
{WARPS}{TILES}"""
    + r"""
// The lanes whose chunks, those from `first` on, stand before chunk `number` and are done: what was written of them can
// be read.
__device__ __forceinline__ unsigned done_before(const int* done, int first, int number) {
    int k = first + threadIdx.x % WARP;
    unsigned lanes = __ballot_sync(EVERY_LANE, k < number && *(const volatile int*)(done + k));
    __threadfence();
    return lanes;
}

// Composites each chunk by itself: premultiplied values (m, 256, CHANNELS), alpha and transmittance (m, 256) by pixel,
// the last entry of the chunk that a pixel shows (-1: none), and the transmittance of objects alone (m, 256). Alpha is
// negative where the ray ends. Rays that have ended in the first chunks of the tile, as far as these are `done` (m; all
// 0 before), show nothing: where chunks are joined, these pixels do not count.
extern "C" __global__ void __launch_bounds__(THREADS) composite_chunks(
    const float* means, const float* conics, const float* values, const float* opacities, const int* ids,
    const long long* order, const int* offsets, const int* firsts, const int* tile_of, float* images, float* alphas,
    float* transmittances, int* lasts, float* object_transmittances, int* done, int tiles, int per_camera, int across,
    int first_object, int end_object
) {
    __shared__ Batch batch;
    Gaussians g = {means, conics, values, opacities};
    Lists lists = {ids, order, offsets, firsts, tile_of, tiles, per_camera, across};
    int number = chunk_of(lists, blockIdx.x);
    if (number < 0) return;
    Chunk chunk(lists, number);
    int thread = threadIdx.x;
    float x = column_of(thread) + 0.5f;
    float y[PIXELS], passes[PIXELS], past_objects[PIXELS], total[PIXELS][CHANNELS] = {};
    int last[PIXELS];
    bool ended[PIXELS], all_ended = true;
    #pragma unroll
    for (int p = 0; p < PIXELS; ++p) {
        y[p] = row_of(thread, p) + 0.5f;
        passes[p] = past_objects[p] = 1.0f;
        last[p] = -1;
        ended[p] = false;
    }
    for (unsigned lanes = done_before(done, chunk.first, number); lanes; lanes &= lanes - 1) {
        int k = chunk.first + __ffs(lanes) - 1;
        #pragma unroll
        for (int p = 0; p < PIXELS; ++p) {
            float alpha = __ldcg(alphas + pixel_of(k, thread, p));
            passes[p] *= 1.0f - fabsf(alpha);
            ended[p] |= alpha < 0.0f || passes[p] <= MIN_TRANSMITTANCE;
        }
    }
    #pragma unroll
    for (int p = 0; p < PIXELS; ++p) {
        passes[p] = 1.0f;
        all_ended &= ended[p];
    }
    for (int begin = chunk.start; begin < chunk.end; begin += THREADS) {
        if (__syncthreads_and(all_ended)) break;
        load(batch, g, lists, chunk, begin + thread);
        __syncthreads();
        for (int first = 0; first < THREADS; first += WARP) {
            for (unsigned lanes = reaching(batch, first); lanes; lanes &= lanes - 1) {
                if (__all_sync(EVERY_LANE, all_ended)) break;
                int j = first + __ffs(lanes) - 1;
                bool is_object = of_object(batch, j, first_object, end_object);
                float dx = batch.x[j] - x;
                #pragma unroll
                for (int p = 0; p < PIXELS; ++p) {
                    float falloff, alpha = alpha_at(batch, j, dx, batch.y[j] - y[p], falloff);
                    if (ended[p] || alpha == 0.0f) continue;
                    float behind = passes[p] * (1.0f - alpha);
                    if (behind <= MIN_TRANSMITTANCE) {
                        ended[p] = true;
                        continue;
                    }
                    #pragma unroll
                    for (int k = 0; k < CHANNELS; ++k) total[p][k] += batch.values[j][k] * alpha * passes[p];
                    passes[p] = behind;
                    if (is_object) past_objects[p] *= 1.0f - alpha;
                    last[p] = begin - chunk.start + j;
                }
                all_ended = true;
                #pragma unroll
                for (int p = 0; p < PIXELS; ++p) all_ended &= ended[p];
            }
        }
    }
    #pragma unroll
    for (int p = 0; p < PIXELS; ++p) {
        long long at = pixel_of(number, thread, p);
        #pragma unroll
        for (int k = 0; k < CHANNELS; ++k) images[at * CHANNELS + k] = total[p][k];
        alphas[at] = ended[p] ? passes[p] - 1.0f : 1.0f - passes[p];
        transmittances[at] = passes[p];
        if (OBJECTS) object_transmittances[at] = past_objects[p];
        lasts[at] = last[p];
    }
    __threadfence();
    __syncthreads();
    if (thread == 0) *(volatile int*)(done + number) = 1;
}

// Adds the gradients of all Gaussians, given those of each chunk's values, absolute alpha and transmittance of objects
// alone.
extern "C" __global__ void __launch_bounds__(THREADS) composite_chunks_backward(
    const float* means, const float* conics, const float* values, const float* opacities, const int* ids,
    const long long* order, const int* offsets, const int* firsts, const int* tile_of, const float* transmittances,
    const int* lasts, const float* object_transmittances, const float* v_images, const float* v_alphas,
    const float* v_object_transmittances,
    float* v_means, float* v_conics, float* v_values, float* v_opacities, int tiles, int per_camera, int across,
    int first_object, int end_object
) {
    if ((int)blockIdx.x >= firsts[tiles]) return;
    __shared__ Batch batch;
    __shared__ int last_of_tile;
    Gaussians g = {means, conics, values, opacities};
    Lists lists = {ids, order, offsets, firsts, tile_of, tiles, per_camera, across};
    Chunk chunk(lists, blockIdx.x);
    int thread = threadIdx.x, lane = thread % WARP;
    float x = column_of(thread) + 0.5f;
    // by pixel: transmittance, gradient of the values; `behind`, the gradient by all that the pixel shows behind the
    // Gaussian at hand; `by_objects`, the gradient of the transmittance of objects times that transmittance
    float y[PIXELS], passes[PIXELS], behind[PIXELS], by_objects[PIXELS], v_pixel[PIXELS][CHANNELS];
    int last[PIXELS], last_of_warp = -1;
    #pragma unroll
    for (int p = 0; p < PIXELS; ++p) {
        long long at = pixel_of(blockIdx.x, thread, p);
        y[p] = row_of(thread, p) + 0.5f;
        passes[p] = transmittances[at];
        behind[p] = -passes[p] * v_alphas[at];
        by_objects[p] = OBJECTS ? v_object_transmittances[at] * object_transmittances[at] : 0.0f;
        bool matters = v_alphas[at] != 0.0f || by_objects[p] != 0.0f;
        #pragma unroll
        for (int k = 0; k < CHANNELS; ++k) {
            v_pixel[p][k] = v_images[at * CHANNELS + k];
            matters |= v_pixel[p][k] != 0.0f;
        }
        last[p] = matters ? lasts[at] : -1;
        last_of_warp = max(last_of_warp, last[p]);
    }
    #pragma unroll
    for (int bit = WARP / 2; bit >= 1; bit /= 2)
        last_of_warp = max(last_of_warp, __shfl_xor_sync(EVERY_LANE, last_of_warp, bit));
    if (thread == 0) last_of_tile = -1;
    __syncthreads();
    if (lane == 0) atomicMax(&last_of_tile, last_of_warp);
    __syncthreads();
    int entries = last_of_tile + 1;
    // where this lane adds its sum
    const int each = WARP / WIDTH, sum = lane / each;
    float* target = sum < CHANNELS ? v_values + sum
        : sum < CHANNELS + 2 ? v_means + (sum - CHANNELS)
        : sum < CHANNELS + 5 ? v_conics + (sum - CHANNELS - 2)
        : v_opacities;
    int stride = sum < CHANNELS ? CHANNELS : sum < CHANNELS + 2 ? 2 : sum < CHANNELS + 5 ? 3 : 1;
    bool adds = lane % each == 0 && sum < GRADIENTS;
    for (int begin = (entries - 1) / THREADS * THREADS; begin >= 0 && entries > 0; begin -= THREADS) {
        __syncthreads();
        load(batch, g, lists, chunk, chunk.start + begin + thread);
        __syncthreads();
        for (int first = THREADS - WARP; first >= 0; first -= WARP) {
            for (unsigned lanes = reaching(batch, first), bit; lanes; lanes ^= bit) {
                int of_lane = WARP - 1 - __clz(lanes), j = first + of_lane;
                bit = 1u << of_lane;
                if (begin + j > last_of_warp) continue;
                float dx = batch.x[j] - x, dy[PIXELS], alpha[PIXELS], falloff[PIXELS];
                bool shown = false;
                #pragma unroll
                for (int p = 0; p < PIXELS; ++p) {
                    dy[p] = batch.y[j] - y[p];
                    alpha[p] = begin + j > last[p] ? 0.0f : alpha_at(batch, j, dx, dy[p], falloff[p]);
                    shown |= alpha[p] != 0.0f;
                }
                if (!__any_sync(EVERY_LANE, shown)) continue;
                bool is_object = of_object(batch, j, first_object, end_object);
                float sums[WIDTH] = {}, along_x = 0.0f, along_y = 0.0f;
                #pragma unroll
                for (int p = 0; p < PIXELS; ++p) {
                    float left = __fdividef(1.0f, 1.0f - alpha[p]);
                    passes[p] *= left;
                    float weight = alpha[p] * passes[p], by_values = 0.0f;
                    #pragma unroll
                    for (int k = 0; k < CHANNELS; ++k) {
                        sums[k] += weight * v_pixel[p][k];
                        by_values += batch.values[j][k] * v_pixel[p][k];
                    }
                    float v_alpha = passes[p] * by_values - left * behind[p];
                    if (is_object) v_alpha -= left * by_objects[p];
                    behind[p] += weight * by_values;
                    bool free = alpha[p] > 0.0f && batch.opacity[j] * falloff[p] <= MAX_ALPHA;
                    float v_opacity = free ? falloff[p] * v_alpha : 0.0f;
                    float v_sigma = -batch.opacity[j] * v_opacity;
                    along_x += v_sigma * dx;
                    along_y += v_sigma * dy[p];
                    sums[CHANNELS + 2] += 0.5f * v_sigma * dx * dx;
                    sums[CHANNELS + 3] += v_sigma * dx * dy[p];
                    sums[CHANNELS + 4] += 0.5f * v_sigma * dy[p] * dy[p];
                    sums[CHANNELS + 5] += v_opacity;
                }
                sums[CHANNELS] = batch.a[j] * along_x + batch.b[j] * along_y;
                sums[CHANNELS + 1] = batch.b[j] * along_x + batch.c[j] * along_y;
                float total = sum_over_lanes<WIDTH / 2>(sums, lane);
                if (adds && total != 0.0f) atomicAdd(target + (long long)stride * batch.id[j], total);
            }
        }
    }
}
"""
)
