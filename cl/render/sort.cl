// sort.cl: a stable radix sort of (key, value) pairs, least significant digit first.
//
// Each pass counts digits, scans the counts and scatters (Zagha and Blelloch 1991). SCAN_GROUP work-items share a block of
// the input. Each has a run of RUN pairs, one after another, so pairs with the same digit keep their order. A block is
// sorted in local memory before it is written: neighbours then write neighbouring places (Satish et al. 2009).
// A run has fewer than 256 pairs and a block fewer than 65 536, so counters have 8 and 16 bits: digits can be wider.
// Pairs are sorted by min(key - base, top): keys that lie close together have fewer digits, and other keys come last.

#define RADIX (1 << RADIX_BITS)
#define HELPERS (SCAN_GROUP / RADIX)  // work-items that share the counters of a digit
#define SHARE (SCAN_GROUP / HELPERS)  // counters of each, a multiple of 4
#define BLOCK (SCAN_GROUP * RUN)

// Counters have a row for each work-item that shares them: helper h of digit d has row d * HELPERS + h. A word is left
// free after each row, so that work-items that go along their rows read different banks of local memory.
#define ROW_WORDS(bytes) (SHARE * (bytes) / 4 + 1)
#define COUNTER_WORDS(bytes) (SCAN_GROUP * ROW_WORDS(bytes))

// The counter of a work-item for a digit, of `bytes` bytes.
static inline uint counter_at(uint digit, uint item, uint bytes) {
    return (digit * HELPERS + item / SHARE) * (ROW_WORDS(bytes) * 4 / bytes) + item % SHARE;
}

static inline uint digit_of(uint key, uint base, uint top, uint shift) {
    return (min(key - base, top) >> shift) & (RADIX - 1);
}

// Overwrites counts [RADIX, n_blocks], digit-major.
SCAN_ATTRIBUTE
kernel void radix_histogram(
    global const uint *restrict keys,
    global uint *restrict counts,
    uint n,
    uint base,
    uint top,
    uint shift
) {
    local uint words[COUNTER_WORDS(1)];
    local uint parts[SCAN_GROUP];
    local uchar *counters = (local uchar *)words;
    const uint lid = get_local_id(0);
    for (uint word = lid; word < COUNTER_WORDS(1); word += SCAN_GROUP) words[word] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    // The order of pairs does not matter here, so neighbours read neighbours.
    const ulong first = (ulong)get_group_id(0) * BLOCK + lid;
    UNROLL for (uint k = 0; k < RUN; ++k) {
        const ulong at = first + k * SCAN_GROUP;
        if (at < n) ++counters[counter_at(digit_of(keys[at], base, top, shift), lid, 1)];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    uint pair_of_sums = 0;  // of the counters at even and at odd bytes
    for (uint k = 0; k < SHARE / 4; ++k) {
        const uint word = words[lid * ROW_WORDS(1) + k];
        pair_of_sums += (word & 0x00FF00FFu) + (word >> 8 & 0x00FF00FFu);
    }
    parts[lid] = (pair_of_sums & 0xFFFFu) + (pair_of_sums >> 16);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lid >= RADIX) return;
    uint sum = 0;
    for (uint h = 0; h < HELPERS; ++h) sum += parts[lid * HELPERS + h];
    counts[lid * get_num_groups(0) + get_group_id(0)] = sum;
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

// Reads the run of a work-item; keys from n on are not read.
static inline void read_run(global const uint *keys, ulong start, uint n, uint *run) {
    if (start + RUN <= n) {
        global const uint4 *from = (global const uint4 *)(keys + start);
        UNROLL for (uint k = 0; k < RUN; k += 4) {
            const uint4 four = from[k / 4];
            run[k] = four.x;
            run[k + 1] = four.y;
            run[k + 2] = four.z;
            run[k + 3] = four.w;
        }
    } else {
        UNROLL for (uint k = 0; k < RUN; ++k) run[k] = start + k < n ? keys[start + k] : 0;
    }
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
    uint base,
    uint top,
    uint shift,
    uint numbered
) {
    // The counters, then the sorted pairs.
    local uint words[COUNTER_WORDS(2) > 2 * BLOCK ? COUNTER_WORDS(2) : 2 * BLOCK];
    local ulong sums[SCAN_GROUP];
    local uint all[RADIX];
    local uint moves[RADIX];  // from the place of a digit's pairs in the block to that in the output, modulo 2^32
    local ushort *counters = (local ushort *)words;
    const uint lid = get_local_id(0);
    const ulong start = (ulong)get_global_id(0) * RUN;
    uint run[RUN], places[RUN];
    read_run(keys, start, n, run);
    for (uint word = lid; word < COUNTER_WORDS(2); word += SCAN_GROUP) words[word] = 0;
    if (lid < RADIX) all[lid] = totals[lid];
    barrier(CLK_LOCAL_MEM_FENCE);
    UNROLL for (uint k = 0; k < RUN; ++k) {
        if (start + k < n) counters[counter_at(digit_of(run[k], base, top, shift), lid, 2)] += 1;
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    local uint *row = words + lid * ROW_WORDS(2);
    uint sum = 0;
    for (uint k = 0; k < SHARE / 2; ++k) sum += (row[k] & 0xFFFFu) + (row[k] >> 16);
    // Each counter becomes the place in the sorted block of the first pair with its digit and from its run. Rows are in the
    // order of these places. The first of two counters is the lower half of a word: devices of OpenCL are little-endian, or
    // the self-test refuses them.
    uint before = (uint)scan_group(sum, sums);
    if (lid < RADIX) {
        uint start_of_digit = counts[lid * get_num_groups(0) + get_group_id(0)];
        for (uint d = 0; d < lid; ++d) start_of_digit += all[d];
        moves[lid] = start_of_digit - (lid ? (uint)sums[lid * HELPERS - 1] : 0);
    }
    for (uint k = 0; k < SHARE / 2; ++k) {
        const uint two = row[k], middle = before + (two & 0xFFFFu);
        row[k] = before | middle << 16;
        before = middle + (two >> 16);
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    UNROLL for (uint k = 0; k < RUN; ++k) {
        places[k] = start + k < n ? counters[counter_at(digit_of(run[k], base, top, shift), lid, 2)]++ : BLOCK;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    UNROLL for (uint k = 0; k < RUN; ++k) {
        if (places[k] < BLOCK) {
            words[places[k]] = run[k];
            words[BLOCK + places[k]] = numbered ? (uint)start + k : values[start + k];
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const ulong first_pair = (ulong)get_group_id(0) * BLOCK;
    const uint n_pairs = first_pair + BLOCK <= n ? BLOCK : (uint)(n - first_pair);
    for (uint place = lid; place < n_pairs; place += SCAN_GROUP) {
        const uint key = words[place], to = place + moves[digit_of(key, base, top, shift)];
        keys_out[to] = key;
        values_out[to] = words[BLOCK + place];
    }
}
