// order.cl: the visible splats by depth, for devices with few work-items (CPUs). The other devices use sort.cl.
//
// A work-item has a chunk of `run` splats. One pass scatters the splats to BUCKETS by the highest bits in which their keys
// differ (a most-significant-digit radix sort; Knuth, TAOCP 5.2.5). Then each bucket, which fits a cache, is sorted by the
// remaining bits. The sort is stable: equal depths keep their index order. Culled splats are left out.

#define BUCKETS (1 << BUCKET_BITS)
#define DIGIT_BITS 8
#define DIGITS (1 << DIGIT_BITS)
#define FEW 48  // up to this number, insertion is faster than counting DIGITS

// Overwrites span [chunks] with the smallest and the largest key of the visible splats of each chunk, (CULLED_KEY, 0) if
// there are none. Sets splat_isects [n] to (0, 0) for culled splats, because no later kernel visits them.
kernel void depth_span(
    global const uint *restrict depth_key,
    global uint2 *restrict span,
    global uint2 *restrict splat_isects,
    uint n_splats,
    uint run
) {
    const uint chunk = get_global_id(0), start = chunk * run, end = min(start + run, n_splats);
    uint smallest = CULLED_KEY, largest = 0;
    for (uint i = start; i < end; ++i) {
        const uint key = depth_key[i];
        if (key == CULLED_KEY) {
            splat_isects[i] = (uint2)(0, 0);
            continue;
        }
        smallest = min(smallest, key);
        largest = max(largest, key);
    }
    span[chunk] = (uint2)(smallest, largest);
}

// Smallest key, and the number of bits below those that choose the bucket.
static inline uint2 bucket_scale(global const uint2 *span, uint n_chunks) {
    uint smallest = CULLED_KEY, largest = 0;
    for (uint c = 0; c < n_chunks; ++c) {
        smallest = min(smallest, span[c].x);
        largest = max(largest, span[c].y);
    }
    const int bits = 32 - (int)clz(largest - smallest);
    return (uint2)(smallest, (uint)max(bits - BUCKET_BITS, 0));
}

// Overwrites counts [chunks, BUCKETS]: the visible splats of each chunk in each bucket.
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
    global uint *of_chunk = counts + (ulong)chunk * BUCKETS;
    for (uint b = 0; b < BUCKETS; ++b) of_chunk[b] = 0;
    for (uint i = start; i < end; ++i)
        if (depth_key[i] != CULLED_KEY) ++of_chunk[(depth_key[i] - scale.x) >> scale.y];
}

// Overwrites pairs [n], (key, splat) by bucket, bucket_starts [BUCKETS + 1], whose last entry is the end, and n_visible [1].
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
    uint all[BUCKETS],
        to[BUCKETS];  // all: counts of all chunks; to: counts of the chunks before this one, then the place to write
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

// Sorts pairs by key, by insertion.
static inline void sort_few(global uint2 *pairs, uint n) {
    for (uint k = 1; k < n; ++k) {
        const uint2 pair = pairs[k];
        uint at = k;
        for (; at > 0 && pairs[at - 1].x > pair.x; --at) pairs[at] = pairs[at - 1];
        pairs[at] = pair;
    }
}

// Sorts pairs by the low `bits` bits of key - smallest, with the least significant digit first. Returns the one of the two
// buffers that holds the result.
static inline global uint2 *sort_many(global uint2 *pairs, global uint2 *spare, uint n, uint smallest, uint bits) {
    for (uint shift = 0; shift < bits; shift += DIGIT_BITS) {
        uint to[DIGITS];
        for (uint d = 0; d < DIGITS; ++d) to[d] = 0;
        for (uint k = 0; k < n; ++k) ++to[(pairs[k].x - smallest) >> shift & (DIGITS - 1)];
        uint place = 0;
        for (uint d = 0; d < DIGITS; ++d) {
            const uint count = to[d];
            to[d] = place;
            place += count;
        }
        for (uint k = 0; k < n; ++k) spare[to[(pairs[k].x - smallest) >> shift & (DIGITS - 1)]++] = pairs[k];
        global uint2 *swap = pairs;
        pairs = spare;
        spare = swap;
    }
    return pairs;
}

// The first bucket that starts at `place` or later.
static inline uint bucket_from(global const uint *bucket_starts, uint place) {
    uint low = 0, high = BUCKETS;
    while (low < high) {
        const uint middle = (low + high) / 2;
        if (bucket_starts[middle] < place) low = middle + 1;
        else high = middle;
    }
    return low;
}

// Overwrites depth_order [n_visible] with the splats from front to back; pairs and spare [n] are lost. Each work-item sorts
// the buckets that start in its part of the places.
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
