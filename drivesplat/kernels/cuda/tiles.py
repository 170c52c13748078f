"""CUDA C++ that both kernels of images share: chunks of tiles' lists, their Gaussians, and the pixels of threads."""

PIXELS = 2
"""Pixels of a thread."""
WAVES = 4
"""The order of blocks: first those of the first chunks of all tiles, then those of the second ones, and so on. The last
of WAVES groups has all other chunks."""

TILES = (
    f"""
#define PIXELS {PIXELS}
#define WAVES {WAVES}
"""
    + r"""
#define TILE 16
#define THREADS (TILE * TILE / PIXELS)
#define MAX_ALPHA 0.999f
#define MIN_ALPHA (1.0f / 255.0f)
#define MIN_TRANSMITTANCE 1e-4f
#define SLACK 0.01f                         // of the exponent, against rounding

struct Gaussians {
    const float *means, *conics, *values, *opacities;
};

struct Lists {
    const int* ids;
    const long long* order;
    const int *offsets, *firsts, *tile_of;
    int tiles, per_camera, across;
};

// The chunk that a block composites, or -1. Blocks begin in the order of their numbers: with the first chunks of all
// tiles, then the second ones, up to WAVES - 1, then all others. The chunks before a block's own are thus mostly done.
__device__ __forceinline__ int chunk_of(const Lists& lists, int block) {
    int wave = block / lists.tiles;
    if (wave < WAVES - 1) {
        int tile = block % lists.tiles, chunk = lists.firsts[tile] + wave;
        return chunk < lists.firsts[tile + 1] ? chunk : -1;
    }
    int chunk = block - (WAVES - 1) * lists.tiles;
    if (chunk >= lists.firsts[lists.tiles]) return -1;
    return chunk - lists.firsts[lists.tile_of[chunk]] >= WAVES - 1 ? chunk : -1;
}

struct Batch {                              // in shared memory: a Gaussian for each thread
    float x[THREADS], y[THREADS], a[THREADS], b[THREADS], c[THREADS], opacity[THREADS];
    float values[THREADS][CHANNELS];
    int id[THREADS];
    float reach[THREADS];                   // the largest exponent within its ellipse; negative for none
};

// A chunk: the first chunk of its tile, its first and last entry, and the corner of its tile in pixels.
struct Chunk {
    int first, start, end;
    float left, top;

    __device__ Chunk(const Lists& lists, int chunk) {
        int tile = lists.tile_of[chunk], within = tile % lists.per_camera;
        first = lists.firsts[tile];
        start = lists.offsets[tile] + (chunk - first) * LENGTH;
        end = min(start + LENGTH, lists.offsets[tile + 1]);
        left = float(within % lists.across * TILE);
        top = float(within / lists.across * TILE);
    }
};

// A warp covers 8 columns and 4 * PIXELS rows of the tile.
__device__ __forceinline__ int column_of(int thread) {
    return thread / WARP % 2 * 8 + thread % 8;
}
__device__ __forceinline__ int row_of(int thread, int pixel) {
    return (thread / WARP / 2 * PIXELS + pixel) * 4 + thread % WARP / 8;
}

// The place of a thread's pixel among those of all chunks.
__device__ __forceinline__ long long pixel_of(int chunk, int thread, int pixel) {
    return (long long)chunk * TILE * TILE + row_of(thread, pixel) * TILE + column_of(thread);
}

__device__ __forceinline__ void load(
    Batch& batch, const Gaussians& g, const Lists& lists, const Chunk& chunk, int entry
) {
    int thread = threadIdx.x;
    batch.reach[thread] = -1e9f;
    if (entry >= chunk.end) return;
    int i = lists.ids[lists.order[entry]];
    long long at = i;
    batch.id[thread] = i;
    batch.x[thread] = g.means[2 * at] - chunk.left;
    batch.y[thread] = g.means[2 * at + 1] - chunk.top;
    batch.a[thread] = g.conics[3 * at];
    batch.b[thread] = g.conics[3 * at + 1];
    batch.c[thread] = g.conics[3 * at + 2];
    float opacity = g.opacities[at];
    batch.opacity[thread] = opacity;
    batch.reach[thread] = __logf(opacity / MIN_ALPHA) + SLACK;
    #pragma unroll
    for (int k = 0; k < CHANNELS; ++k) batch.values[thread][k] = g.values[CHANNELS * at + k];
}

// The least of 0.5 (a u^2 + c v^2) + b u v over v in [low, high], with a, c > 0.
__device__ __forceinline__ float least_along(float a, float b, float c, float u, float low, float high) {
    float v = fminf(fmaxf(__fdividef(-b * u, c), low), high);
    return 0.5f * (a * u * u + c * v * v) + b * u * v;
}

// The lanes whose Gaussians, those from `first` on, reach the pixels of this warp: where the exponent is least over the
// rectangle of the pixels' centres, at the centre of the Gaussian or on an edge that faces it.
__device__ __forceinline__ unsigned reaching(const Batch& batch, int first) {
    int j = first + threadIdx.x % WARP, warp = threadIdx.x / WARP;
    float left = warp % 2 * 8 + 0.5f - batch.x[j], right = left + 7.0f;
    float top = warp / 2 * PIXELS * 4 + 0.5f - batch.y[j], bottom = top + PIXELS * 4 - 1.0f;
    float x = fminf(fmaxf(0.0f, left), right), y = fminf(fmaxf(0.0f, top), bottom);  // nearest to the centre
    float a = batch.a[j], b = batch.b[j], c = batch.c[j], reach = batch.reach[j];
    bool reaches = x == 0.0f && y == 0.0f;
    reaches |= x != 0.0f && least_along(a, b, c, x, top, bottom) <= reach;
    reaches |= y != 0.0f && least_along(c, b, a, y, left, right) <= reach;
    return __ballot_sync(EVERY_LANE, reaches && reach >= 0.0f);
}

// The alpha of Gaussian j at the offset (dx, dy) of a pixel, 0 below MIN_ALPHA; falloff is its part without opacity.
__device__ __forceinline__ float alpha_at(const Batch& batch, int j, float dx, float dy, float& falloff) {
    float sigma = 0.5f * (batch.a[j] * dx * dx + batch.c[j] * dy * dy) + batch.b[j] * dx * dy;
    falloff = __expf(-sigma);
    float alpha = fminf(MAX_ALPHA, batch.opacity[j] * falloff);
    return sigma < 0.0f || alpha < MIN_ALPHA ? 0.0f : alpha;
}

// Whether Gaussian j of a batch belongs to an object.
__device__ __forceinline__ bool of_object(const Batch& batch, int j, int first_object, int end_object) {
    return OBJECTS && batch.id[j] >= first_object && batch.id[j] < end_object;
}
"""
)
"""Chunks, batches of their Gaussians, and alpha. Needs `warps.WARPS`, and CHANNELS, LENGTH and OBJECTS defined."""
