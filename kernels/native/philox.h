// Philox4x32-10 (Salmon et al. 2011) of counters that follow each other.
//
// `kernels/observe/sensor.py` says what counters are. Integers only: vectors and CUDA have the
// same bits. Needs lanes.h.

#ifndef R2H_PHILOX_H
#define R2H_PHILOX_H

namespace r2h {

// One call makes eight blocks with the vectors of clang for CPUs. On CUDA it makes one: threads
// lie side by side there. A word has 64 bits, of which the upper half is 0: what vectors of a CPU
// multiply.
#if defined(R2H_VECTORS)
typedef bits64 wide_words __attribute__((ext_vector_type(8)));
typedef unsigned int words __attribute__((ext_vector_type(8)));
static inline words narrow(wide_words x) { return __builtin_convertvector(x, words); }
static inline wide_words counting(bits64 first) { return wide_words{0, 1, 2, 3, 4, 5, 6, 7} + first; }
static inline void put(unsigned int *p, words x) { __builtin_memcpy(p, &x, sizeof(x)); }
R2H_FUNCTION int philox_blocks() { return 8; }
#else
typedef bits64 wide_words;
typedef unsigned int words;
R2H_FUNCTION words narrow(wide_words x) { return (words)x; }
R2H_FUNCTION wide_words counting(bits64 first) { return first; }
R2H_FUNCTION void put(unsigned int *p, words x) { *p = x; }
R2H_FUNCTION int philox_blocks() { return 1; }
#endif

// The blocks of (trial; first_pixel + k, purpose). Entry (w, k) of the matrix is word w of block k.
template <typename Words>
R2H_FUNCTION Words philox(unsigned int key_0, unsigned int key_1, long long trial, int first_pixel, unsigned int purpose) {
    const bits64 low = 0xFFFFFFFFull;
    wide_words a = (bits64)trial & low, b = (bits64)trial >> 32;
    wide_words c = counting((unsigned int)first_pixel) & low, d = (bits64)purpose << 16;
    for (int round = 0; round < 10; ++round) {
        const wide_words p = (a & low) * 0xD2511F53ull, q = (c & low) * 0xCD9E8D57ull;
        a = (q >> 32) ^ b ^ (bits64)key_0;
        b = q & low;
        c = (p >> 32) ^ d ^ (bits64)key_1;
        d = p & low;
        key_0 += 0x9E3779B9u;
        key_1 += 0xBB67AE85u;
    }
    Words found;
    put(found.data[0], narrow(a));
    put(found.data[1], narrow(b));
    put(found.data[2], narrow(c));
    put(found.data[3], narrow(d));
    return found;
}

} // namespace r2h

#endif
