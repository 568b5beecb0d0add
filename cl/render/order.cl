// order.cl: visible splats by depth, for devices of few work-items (CPUs); sort.cl is for the others.
//
// Work is cut into chunks of `run` splats, one work-item each. One pass scatters the splats to BUCKETS by the highest
// bits in which their keys differ; then each bucket, which fits a cache, is sorted by the rest. Stable throughout:
// equal depths keep their index order. Culled splats are left out.

#define BUCKETS (1 << BUCKET_BITS)
#define DIGIT_BITS 8
#define DIGITS (1 << DIGIT_BITS)
#define FEW 48  // so few are sorted by insertion: counting DIGITS would cost more

// span [chunks]: least and greatest key of each chunk's visible splats; (CULLED_KEY, 0) without any.
// splat_isects [n]: (0, 0) for culled splats, which no later kernel meets.
kernel void depth_span(
    global const uint *restrict depth_key,
    global uint2 *restrict span,
    global uint2 *restrict splat_isects,
    uint n_splats,
    uint run
) {
    const uint chunk = get_global_id(0), start = chunk * run, end = min(start + run, n_splats);
    uint least = CULLED_KEY, most = 0;
    for (uint i = start; i < end; ++i) {
        const uint key = depth_key[i];
        if (key == CULLED_KEY) {
            splat_isects[i] = (uint2)(0, 0);
            continue;
        }
        least = min(least, key);
        most = max(most, key);
    }
    span[chunk] = (uint2)(least, most);
}

// Least key of all, and the bits below those that choose the bucket.
static inline uint2 bucket_scale(global const uint2 *span, uint n_chunks) {
    uint least = CULLED_KEY, most = 0;
    for (uint c = 0; c < n_chunks; ++c) {
        least = min(least, span[c].x);
        most = max(most, span[c].y);
    }
    const int bits = 32 - (int)clz(most - least);
    return (uint2)(least, (uint)max(bits - BUCKET_BITS, 0));
}

// counts [chunks, BUCKETS]: visible splats. Overwrites.
kernel void depth_histogram(
    global const uint *restrict depth_key,
    global const uint2 *restrict span,
    global uint *restrict counts,
    uint n_splats,
    uint run,
    uint n_chunks
) {
    const uint chunk = get_global_id(0), start = chunk * run, end = min(start + run, n_splats);
    const uint2 scale = bucket_scale(span, n_chunks);
    global uint *own = counts + (ulong)chunk * BUCKETS;
    for (uint b = 0; b < BUCKETS; ++b) own[b] = 0;
    for (uint i = start; i < end; ++i)
        if (depth_key[i] != CULLED_KEY) ++own[(depth_key[i] - scale.x) >> scale.y];
}

// pairs [n]: (key, splat) by bucket. bucket_starts [BUCKETS + 1]: the last is past the end. n_visible [1]: that number.
kernel void depth_scatter(
    global const uint *restrict depth_key,
    global const uint2 *restrict span,
    global const uint *restrict counts,
    global uint2 *restrict pairs,
    global uint *restrict bucket_starts,
    global uint *restrict n_visible,
    uint n_splats,
    uint run,
    uint n_chunks
) {
    const uint chunk = get_global_id(0), start = chunk * run, end = min(start + run, n_splats);
    const uint2 scale = bucket_scale(span, n_chunks);
    uint all[BUCKETS], to[BUCKETS];  // all: of every chunk; to: of the chunks before this one, then the place to write
    for (uint b = 0; b < BUCKETS; ++b) all[b] = to[b] = 0;
    for (uint c = 0; c < n_chunks; ++c) {
        global const uint *from = counts + (ulong)c * BUCKETS;
        const uint before = c < chunk ? 0xFFFFFFFFu : 0u;
        for (uint b = 0; b < BUCKETS; ++b) {
            all[b] += from[b];
            to[b] += from[b] & before;
        }
    }
    uint place = 0;
    for (uint b = 0; b < BUCKETS; ++b) {
        to[b] += place;
        if (chunk == 0) bucket_starts[b] = place;
        place += all[b];
    }
    if (chunk == 0) bucket_starts[BUCKETS] = n_visible[0] = place;
    for (uint i = start; i < end; ++i) {
        const uint key = depth_key[i];
        if (key != CULLED_KEY) pairs[to[(key - scale.x) >> scale.y]++] = (uint2)(key, i);
    }
}

// Insertion sort by key.
static inline void sort_few(global uint2 *pairs, uint n) {
    for (uint k = 1; k < n; ++k) {
        const uint2 pair = pairs[k];
        uint at = k;
        for (; at > 0 && pairs[at - 1].x > pair.x; --at) pairs[at] = pairs[at - 1];
        pairs[at] = pair;
    }
}

// Radix sort by the low `bits` bits of key - least; returns the one of the two buffers that holds the result.
static inline global uint2 *sort_many(global uint2 *pairs, global uint2 *spare, uint n, uint least, uint bits) {
    for (uint shift = 0; shift < bits; shift += DIGIT_BITS) {
        uint to[DIGITS];
        for (uint d = 0; d < DIGITS; ++d) to[d] = 0;
        for (uint k = 0; k < n; ++k) ++to[(pairs[k].x - least) >> shift & (DIGITS - 1)];
        uint place = 0;
        for (uint d = 0; d < DIGITS; ++d) {
            const uint count = to[d];
            to[d] = place;
            place += count;
        }
        for (uint k = 0; k < n; ++k) spare[to[(pairs[k].x - least) >> shift & (DIGITS - 1)]++] = pairs[k];
        global uint2 *swap = pairs;
        pairs = spare;
        spare = swap;
    }
    return pairs;
}

// First bucket that starts at `place` or later.
static inline uint bucket_from(global const uint *bucket_starts, uint place) {
    uint low = 0, high = BUCKETS;
    while (low < high) {
        const uint middle = (low + high) / 2;
        if (bucket_starts[middle] < place) low = middle + 1;
        else high = middle;
    }
    return low;
}

// depth_order [n visible]: splats front to back. pairs, spare [n]: lost. Each work-item sorts the buckets that start in
// its part of the places.
kernel void depth_buckets(
    global const uint *restrict bucket_starts,
    global const uint2 *restrict span,
    global uint2 *restrict pairs,
    global uint2 *restrict spare,
    global uint *restrict depth_order,
    uint n_chunks
) {
    const uint2 scale = bucket_scale(span, n_chunks);
    const ulong part = get_global_id(0), n = bucket_starts[BUCKETS];
    const uint last = bucket_from(bucket_starts, (uint)((part + 1) * n / get_global_size(0)));
    for (uint b = bucket_from(bucket_starts, (uint)(part * n / get_global_size(0))); b < last; ++b) {
        const uint start = bucket_starts[b], count = bucket_starts[b + 1] - start;
        global uint2 *sorted = pairs + start;
        if (count <= FEW) sort_few(sorted, count);
        else sorted = sort_many(sorted, spare + start, count, scale.x, scale.y);
        for (uint k = 0; k < count; ++k) depth_order[start + k] = sorted[k].y;
    }
}
