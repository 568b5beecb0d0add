// sort.cl: a stable radix sort of (key, value) pairs, least significant digit first.
//
// Each pass counts digits, scans the counts and scatters (Zagha and Blelloch 1991). SCAN_GROUP work-items share a block of
// the input. Each has a contiguous run of it, so pairs with the same digit keep their order. RADIX = 1 << RADIX_BITS.
// A run has fewer than 256 pairs and a block fewer than 65 536, so counters have 8 and 16 bits: digits can be wider.
// Pairs are sorted by min(key - base, top): keys that lie close together have fewer digits, and other keys come last.

#define RADIX (1 << RADIX_BITS)
#define HELPERS (SCAN_GROUP / RADIX)  // work-items that share the counters of a digit
#define SHARE (SCAN_GROUP / HELPERS)  // counters of each

static inline uint digit_of(uint key, uint base, uint top, uint shift) {
    return (min(key - base, top) >> shift) & (RADIX - 1);
}

// Overwrites hist[digit * SCAN_GROUP + item] with the histograms of this group's runs. A macro, because counters of a run have
// 8 bits, and places in a block 16.
#define COUNT_DIGITS(hist) \
    { \
        const uint lid_ = get_local_id(0); \
        for (uint d = 0; d < RADIX; ++d) hist[d * SCAN_GROUP + lid_] = 0; \
        const ulong start_ = (ulong)get_global_id(0) * run; \
        for (ulong k = start_; k < start_ + run && k < n; ++k) \
            ++hist[digit_of(keys[k], base, top, shift) * SCAN_GROUP + lid_]; \
        barrier(CLK_LOCAL_MEM_FENCE); \
    }

// Writes to parts [SCAN_GROUP] the sum of the counters that each work-item has a share of: helper h of digit d is d * HELPERS
// + h.
#define SHARE_SUMS(hist, parts) \
    { \
        const uint lid_ = get_local_id(0); \
        uint sum_ = 0; \
        for (uint k = 0; k < SHARE; ++k) sum_ += hist[lid_ * SHARE + k]; \
        parts[lid_] = sum_; \
        barrier(CLK_LOCAL_MEM_FENCE); \
    }

// Overwrites counts [RADIX, n_blocks], digit-major.
SCAN_ATTRIBUTE
kernel void radix_histogram(
    global const uint *restrict keys,
    global uint *restrict counts,
    uint n,
    uint run,
    uint base,
    uint top,
    uint shift
) {
    local uchar hist[RADIX * SCAN_GROUP];  // a run has fewer than 256 pairs
    local uint parts[SCAN_GROUP];
    COUNT_DIGITS(hist)
    SHARE_SUMS(hist, parts)
    const uint d = get_local_id(0);
    if (d >= RADIX) return;
    uint sum = 0;
    for (uint h = 0; h < HELPERS; ++h) sum += parts[d * HELPERS + h];
    counts[d * get_num_groups(0) + get_group_id(0)] = sum;
}

// Replaces the counts of each digit by their exclusive scan over the blocks, and overwrites totals [RADIX] with their sums.
// A group for each digit.
SCAN_ATTRIBUTE
kernel void radix_scan(global uint *restrict counts, global uint *restrict totals, uint n_blocks) {
    local ulong sums[SCAN_GROUP];
    const uint lid = get_local_id(0), digit = get_group_id(0);
    const ulong total = scan_blocks(counts + (ulong)digit * n_blocks, n_blocks, sums);
    if (lid == 0) totals[digit] = (uint)total;
}

// Overwrites keys_out and values_out with the pairs by digit. counts and totals: what radix_scan wrote. If `numbered`, the
// value of a pair is its place, and values are not read.
SCAN_ATTRIBUTE
kernel void radix_scatter(
    global const uint *restrict keys,
    global const uint *restrict values,
    global const uint *restrict counts,
    global const uint *restrict totals,
    global uint *restrict keys_out,
    global uint *restrict values_out,
    uint n,
    uint run,
    uint base,
    uint top,
    uint shift,
    uint numbered
) {
    local ushort hist[RADIX * SCAN_GROUP];
    local uint parts[SCAN_GROUP], starts[RADIX];
    const uint lid = get_local_id(0);
    if (lid < RADIX) {
        uint at = counts[lid * get_num_groups(0) + get_group_id(0)];
        for (uint d = 0; d < lid; ++d) at += totals[d];
        starts[lid] = at;
    }
    COUNT_DIGITS(hist)
    SHARE_SUMS(hist, parts)
    // Each counter becomes the number of pairs with its digit in the runs before its own.
    uint before = 0;
    for (uint h = lid / HELPERS * HELPERS; h < lid; ++h) before += parts[h];
    for (uint k = 0; k < SHARE; ++k) {
        const uint count = hist[lid * SHARE + k];
        hist[lid * SHARE + k] = (ushort)before;
        before += count;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const ulong start = (ulong)get_global_id(0) * run;
    for (ulong k = start; k < start + run && k < n; ++k) {
        const uint key = keys[k], digit = digit_of(key, base, top, shift);
        const uint to = starts[digit] + hist[digit * SCAN_GROUP + lid]++;
        keys_out[to] = key;
        values_out[to] = numbered ? (uint)k : values[k];
    }
}
