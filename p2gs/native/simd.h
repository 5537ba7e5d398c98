// Vectors of W floats for the instruction set of this translation unit: 16 (AVX-512), 8 (AVX2) or 4 (anything, by compiler
// vector extensions). Included inside namespace p2gs::<isa>; isa_body.inc has included the intrinsics.
//
// fma() is one rounding where the machine has it. Code whose decisions must be the same in two places writes fma() explicitly and
// puts opaque() around a product that it then adds, so that the compiler has nothing left to contract.
#define P2GS_INLINE static inline __attribute__((always_inline))

#if defined(__AVX512F__)
constexpr int W = 16;
typedef __mmask16 VM;
#elif defined(__AVX2__)
constexpr int W = 8;
#else
constexpr int W = 4;
#endif
typedef float VF __attribute__((vector_size(4 * W)));
typedef int32_t VI __attribute__((vector_size(4 * W)));
typedef float F4 __attribute__((vector_size(16)));
typedef int32_t I4 __attribute__((vector_size(16)));
#if !defined(__AVX512F__)
typedef VI VM;
#endif

#if defined(__clang__)
#define P2GS_SHUFFLE4(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define P2GS_SHUFFLE4(a, b, i, j, k, l) __builtin_shuffle(a, b, (I4){i, j, k, l})
#endif

P2GS_INLINE const char* prefetch_lines(const char* p, int64_t bytes) {
    for (int64_t i = 0; i < bytes; i += 64) __builtin_prefetch(p + i);
    return p + bytes;
}

P2GS_INLINE VF load(const float* p) { return *reinterpret_cast<const VF*>(p); }
P2GS_INLINE void store(float* p, VF v) { *reinterpret_cast<VF*>(p) = v; }
P2GS_INLINE void store_int(int32_t* p, VI v) { *reinterpret_cast<VI*>(p) = v; }
P2GS_INLINE VF loadu(const float* p) {
    VF v;
    memcpy(&v, p, sizeof v);
    return v;
}
P2GS_INLINE void storeu(float* p, VF v) { memcpy(p, &v, sizeof v); }
P2GS_INLINE F4 loadu4(const float* p) {
    F4 v;
    memcpy(&v, p, sizeof v);
    return v;
}
P2GS_INLINE void storeu4(float* p, F4 v) { memcpy(p, &v, sizeof v); }
// The first n <= W floats; the rest is zero.
P2GS_INLINE VF load_part(const float* p, int n) {
#if defined(__AVX512F__)
    return (VF)_mm512_maskz_loadu_ps(__mmask16((1u << n) - 1), p);
#else
    VF v = {};
    memcpy(&v, p, 4 * n);
    return v;
#endif
}
P2GS_INLINE void store_part(float* p, VF v, int n) {
#if defined(__AVX512F__)
    _mm512_mask_storeu_ps(p, __mmask16((1u << n) - 1), (__m512)v);
#else
    memcpy(p, &v, 4 * n);
#endif
}

#if defined(__AVX512F__)
P2GS_INLINE VF set(float x) { return (VF)_mm512_set1_ps(x); }
P2GS_INLINE VF fma(VF a, VF b, VF c) { return (VF)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
P2GS_INLINE VF fnma(VF a, VF b, VF c) { return (VF)_mm512_fnmadd_ps((__m512)a, (__m512)b, (__m512)c); }
P2GS_INLINE VF min(VF a, VF b) { return (VF)_mm512_min_ps((__m512)a, (__m512)b); }
P2GS_INLINE VF max(VF a, VF b) { return (VF)_mm512_max_ps((__m512)a, (__m512)b); }
P2GS_INLINE VF abs(VF a) { return (VF)_mm512_abs_ps((__m512)a); }
P2GS_INLINE VF sqrt(VF a) { return (VF)_mm512_sqrt_ps((__m512)a); }
P2GS_INLINE VF floor(VF a) { return (VF)_mm512_roundscale_ps((__m512)a, 9); }
P2GS_INLINE VI to_int(VF a) { return (VI)_mm512_cvttps_epi32((__m512)a); }
P2GS_INLINE VM ge(VF a, VF b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
P2GS_INLINE VM gt(VF a, VF b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
P2GS_INLINE VM lt(VM m, VF a, VF b) { return _mm512_mask_cmp_ps_mask(m, (__m512)a, (__m512)b, _CMP_LT_OQ); }
P2GS_INLINE VM le(VF a, VF b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LE_OQ); }
P2GS_INLINE VM gt(VM m, VF a, VF b) { return _mm512_mask_cmp_ps_mask(m, (__m512)a, (__m512)b, _CMP_GT_OQ); }
P2GS_INLINE VM le(VM m, VF a, VF b) { return _mm512_mask_cmp_ps_mask(m, (__m512)a, (__m512)b, _CMP_LE_OQ); }
P2GS_INLINE VM both(VM a, VM b) { return VM(a & b); }
P2GS_INLINE VM but_not(VM a, VM b) { return VM(a & ~b); }
P2GS_INLINE VF zero_unless(VM m, VF a) { return (VF)_mm512_maskz_mov_ps(m, (__m512)a); }
P2GS_INLINE VF mul_if(VM m, VF a, VF b) { return (VF)_mm512_maskz_mul_ps(m, (__m512)a, (__m512)b); }
P2GS_INLINE VF pick(VM m, VF yes, VF no) { return (VF)_mm512_mask_mov_ps((__m512)no, m, (__m512)yes); }
P2GS_INLINE bool any(VM m) { return m != 0; }
P2GS_INLINE unsigned bits(VM m) { return m; }
P2GS_INLINE VM lanes_of(unsigned bits) { return VM(bits); }
P2GS_INLINE VF reciprocal(VF a) {
    __m512 r = _mm512_rcp14_ps((__m512)a);
    __m512 e = _mm512_fnmadd_ps((__m512)a, r, _mm512_set1_ps(1.0f));
    return (VF)_mm512_fmadd_ps(r, e, r);
}
P2GS_INLINE VF opaque(VF a) {
    asm("" : "+v"(a));
    return a;
}
#elif defined(__AVX2__)
P2GS_INLINE VF set(float x) { return (VF)_mm256_set1_ps(x); }
P2GS_INLINE VF fma(VF a, VF b, VF c) { return (VF)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
P2GS_INLINE VF fnma(VF a, VF b, VF c) { return (VF)_mm256_fnmadd_ps((__m256)a, (__m256)b, (__m256)c); }
P2GS_INLINE VF min(VF a, VF b) { return (VF)_mm256_min_ps((__m256)a, (__m256)b); }
P2GS_INLINE VF max(VF a, VF b) { return (VF)_mm256_max_ps((__m256)a, (__m256)b); }
P2GS_INLINE VF sqrt(VF a) { return (VF)_mm256_sqrt_ps((__m256)a); }
P2GS_INLINE VF floor(VF a) { return (VF)_mm256_floor_ps((__m256)a); }
P2GS_INLINE VI to_int(VF a) { return (VI)_mm256_cvttps_epi32((__m256)a); }
P2GS_INLINE VF pick(VM m, VF yes, VF no) { return (VF)_mm256_blendv_ps((__m256)no, (__m256)yes, (__m256)m); }
P2GS_INLINE bool any(VM m) { return _mm256_movemask_ps((__m256)m) != 0; }
P2GS_INLINE unsigned bits(VM m) { return unsigned(_mm256_movemask_ps((__m256)m)); }
P2GS_INLINE VF reciprocal(VF a) {
    __m256 r = _mm256_rcp_ps((__m256)a);
    __m256 e = _mm256_fnmadd_ps((__m256)a, r, _mm256_set1_ps(1.0f));
    return (VF)_mm256_fmadd_ps(r, e, r);
}
P2GS_INLINE VF opaque(VF a) {
    asm("" : "+x"(a));
    return a;
}
#else
P2GS_INLINE VF set(float x) { return (VF){x, x, x, x}; }
#if defined(__aarch64__)
P2GS_INLINE VF fma(VF a, VF b, VF c) { return (VF)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b); }
P2GS_INLINE VF fnma(VF a, VF b, VF c) { return (VF)vfmsq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b); }
#else
P2GS_INLINE VF fma(VF a, VF b, VF c) { return a * b + c; }
P2GS_INLINE VF fnma(VF a, VF b, VF c) { return c - a * b; }
#endif
P2GS_INLINE VF pick(VM m, VF yes, VF no) { return (VF)((m & (VI)yes) | (~m & (VI)no)); }
P2GS_INLINE VF reciprocal(VF a) { return set(1.0f) / a; }
#if defined(__SSE2__)
P2GS_INLINE VF sqrt(VF a) { return (VF)_mm_sqrt_ps((__m128)a); }
P2GS_INLINE VF min(VF a, VF b) { return (VF)_mm_min_ps((__m128)a, (__m128)b); }
P2GS_INLINE VF max(VF a, VF b) { return (VF)_mm_max_ps((__m128)a, (__m128)b); }
P2GS_INLINE VI to_int(VF a) { return (VI)_mm_cvttps_epi32((__m128)a); }
P2GS_INLINE unsigned bits(VM m) { return unsigned(_mm_movemask_ps((__m128)m)); }
P2GS_INLINE VF opaque(VF a) {
    asm("" : "+x"(a));
    return a;
}
#else
P2GS_INLINE VF sqrt(VF a) { return (VF){sqrtf(a[0]), sqrtf(a[1]), sqrtf(a[2]), sqrtf(a[3])}; }
P2GS_INLINE VF min(VF a, VF b) { return pick(a < b, a, b); }
P2GS_INLINE VF max(VF a, VF b) { return pick(a > b, a, b); }
P2GS_INLINE VI to_int(VF a) { return __builtin_convertvector(a, VI); }
P2GS_INLINE unsigned bits(VM m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
P2GS_INLINE VF opaque(VF a) {
#if defined(__aarch64__)
    asm("" : "+w"(a));
#endif
    return a;
}
#endif
// |a| < 2^31
P2GS_INLINE VF floor(VF a) {
    VF t = __builtin_convertvector(to_int(a), VF);
    return t - (VF)((t > a) & (VI)set(1.0f));
}
P2GS_INLINE bool any(VM m) { return bits(m) != 0; }
#endif

#if !defined(__AVX512F__)
P2GS_INLINE VF abs(VF a) { return (VF)((VI)a & 0x7fffffff); }
P2GS_INLINE VM ge(VF a, VF b) { return a >= b; }
P2GS_INLINE VM gt(VF a, VF b) { return a > b; }
P2GS_INLINE VM lt(VM m, VF a, VF b) { return m & (a < b); }
P2GS_INLINE VM le(VF a, VF b) { return a <= b; }
P2GS_INLINE VM gt(VM m, VF a, VF b) { return m & (a > b); }
P2GS_INLINE VM le(VM m, VF a, VF b) { return m & (a <= b); }
P2GS_INLINE VM both(VM a, VM b) { return a & b; }
P2GS_INLINE VM but_not(VM a, VM b) { return a & ~b; }
P2GS_INLINE VF zero_unless(VM m, VF a) { return (VF)(m & (VI)a); }
P2GS_INLINE VF mul_if(VM m, VF a, VF b) { return (VF)(m & (VI)(a * b)); }
#endif

#if !defined(__AVX512F__)
// The inverse of bits().
P2GS_INLINE VM lanes_of(unsigned bits) {
    VM m;
    for (int i = 0; i < W; ++i) m[i] = bits >> i & 1 ? -1 : 0;
    return m;
}
#endif

// 2^x for x in [-126, 126]. AVX-512: 2^(k/16) from a table in a register times a parabola, relative error 4.3e-7. Else a minimax
// polynomial of degree 5 around the nearest integer, relative error 1e-7. Adding `magic` rounds x to a number that sits in the low bits.
P2GS_INLINE VF exp2(VF x) {
#if defined(__AVX512F__)
    // bits of 2^(k/16), less k << 19: what (16 x) << 19 adds to the mantissa
    const __m512i table = _mm512_setr_epi32(0x3f800000, 0x3f7daac3, 0x3f7b95c2, 0x3f79c3d3, 0x3f7837f0, 0x3f76f532, 0x3f75fed7, 0x3f75583f,
                                            0x3f7504f3, 0x3f7508a4, 0x3f75672a, 0x3f76248c, 0x3f7744fd, 0x3f78ccdf, 0x3f7ac0c7, 0x3f7d257d);
    const VF magic = set(786432.0f);  // 1.5 * 2^19: steps of 1/16
    VF t = x + magic;
    VF f = x - (t - magic);
    VF p = fma(fma(set(0.24022643f), f, set(0.69318772f)), f, set(1.0f));
    __m512i e = _mm512_add_epi32(_mm512_slli_epi32((__m512i)t, 19), _mm512_permutexvar_epi32((__m512i)t, table));
    return p * (VF)e;
#else
    const VF magic = set(12582912.0f);  // 1.5 * 2^23
    VF t = x + magic;
    VF f = x - (t - magic);
    VF p = set(0.001327647207f);
    p = fma(p, f, set(0.009675541453f));
    p = fma(p, f, set(0.05550713274f));
    p = fma(p, f, set(0.2402211972f));
    p = fma(p, f, set(0.6931469671f));
    p = fma(p, f, set(1.000000072f));
    return (VF)((VI)p + ((VI)t << 23));
#endif
}

// log2(x) for normal x > 0, absolute error about 1e-7: exponent plus the series of 2 atanh((m - 1) / (m + 1)), m in [0.71, 1.41].
P2GS_INLINE VF log2(VF x) {
    VI i = (VI)x - 0x3f3504f3;
    VI e = i >> 23;
    VF m = (VF)((i & 0x007fffff) + 0x3f3504f3);
    VF s = (m - set(1.0f)) / (m + set(1.0f));
    VF s2 = s * s;
    VF p = set(0.32059889f);
    p = fma(p, s2, set(0.41219858f));
    p = fma(p, s2, set(0.57707802f));
    p = fma(p, s2, set(0.96179670f));
    p = fma(p, s2, set(2.88539008f));
    return fma(p, s, __builtin_convertvector(e, VF));
}

// W x W transpose in place.
P2GS_INLINE void transpose(VF* r) {
#if defined(__AVX512F__)
    __m512 t[16], q[16];
    for (int i = 0; i < 16; i += 2) {
        t[i] = _mm512_unpacklo_ps((__m512)r[i], (__m512)r[i + 1]);
        t[i + 1] = _mm512_unpackhi_ps((__m512)r[i], (__m512)r[i + 1]);
    }
    for (int i = 0; i < 16; i += 4)
        for (int k = 0; k < 2; ++k) {  // q[i + c] = column c of rows i .. i + 3, per 128 bits
            __m512d a = _mm512_castps_pd(t[i + k]), b = _mm512_castps_pd(t[i + 2 + k]);
            q[i + 2 * k] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, b));
            q[i + 2 * k + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, b));
        }
    for (int c = 0; c < 4; ++c) {
        __m512 a = _mm512_shuffle_f32x4(q[c], q[4 + c], 0x88), b = _mm512_shuffle_f32x4(q[8 + c], q[12 + c], 0x88);
        __m512 d = _mm512_shuffle_f32x4(q[c], q[4 + c], 0xdd), e = _mm512_shuffle_f32x4(q[8 + c], q[12 + c], 0xdd);
        r[c] = (VF)_mm512_shuffle_f32x4(a, b, 0x88);
        r[8 + c] = (VF)_mm512_shuffle_f32x4(a, b, 0xdd);
        r[4 + c] = (VF)_mm512_shuffle_f32x4(d, e, 0x88);
        r[12 + c] = (VF)_mm512_shuffle_f32x4(d, e, 0xdd);
    }
#elif defined(__AVX2__)
    __m256 t[8], q[8];
    for (int i = 0; i < 8; i += 2) {
        t[i] = _mm256_unpacklo_ps((__m256)r[i], (__m256)r[i + 1]);
        t[i + 1] = _mm256_unpackhi_ps((__m256)r[i], (__m256)r[i + 1]);
    }
    for (int i = 0; i < 8; i += 4)
        for (int k = 0; k < 2; ++k) {
            q[i + 2 * k] = _mm256_shuffle_ps(t[i + k], t[i + 2 + k], 0x44);
            q[i + 2 * k + 1] = _mm256_shuffle_ps(t[i + k], t[i + 2 + k], 0xee);
        }
    for (int c = 0; c < 4; ++c) {
        r[c] = (VF)_mm256_permute2f128_ps(q[c], q[4 + c], 0x20);
        r[4 + c] = (VF)_mm256_permute2f128_ps(q[c], q[4 + c], 0x31);
    }
#else
    VF a = P2GS_SHUFFLE4(r[0], r[1], 0, 4, 1, 5), b = P2GS_SHUFFLE4(r[0], r[1], 2, 6, 3, 7);
    VF c = P2GS_SHUFFLE4(r[2], r[3], 0, 4, 1, 5), d = P2GS_SHUFFLE4(r[2], r[3], 2, 6, 3, 7);
    r[0] = P2GS_SHUFFLE4(a, c, 0, 1, 4, 5);
    r[1] = P2GS_SHUFFLE4(a, c, 2, 3, 6, 7);
    r[2] = P2GS_SHUFFLE4(b, d, 0, 1, 4, 5);
    r[3] = P2GS_SHUFFLE4(b, d, 2, 3, 6, 7);
#endif
}

// columns[c] = element c of each of W rows, c < n. Reads nothing behind the rows' first n floats.
P2GS_INLINE void load_columns(const float* const* rows, int n, VF* columns) {
    for (int c = 0; c < n; c += W) {
        VF r[W];
        if (c + W <= n)
            for (int i = 0; i < W; ++i) r[i] = loadu(rows[i] + c);
        else
            for (int i = 0; i < W; ++i) r[i] = load_part(rows[i] + c, n - c);
        transpose(r);
        for (int i = 0; i < W && c + i < n; ++i) columns[c + i] = r[i];
    }
}

// The inverse, for the first `count` rows. kStream: past the caches, where rows are aligned and the machine can.
template <bool kStream = false>
P2GS_INLINE void store_columns(float* const* rows, int count, int n, const VF* columns) {
    for (int c = 0; c < n; c += W) {
        VF r[W];
        for (int i = 0; i < W; ++i) r[i] = c + i < n ? columns[c + i] : VF{};
        transpose(r);
        if (c + W <= n)
            for (int i = 0; i < count; ++i) {
#if defined(__AVX512F__)
                if (kStream && reinterpret_cast<uintptr_t>(rows[i]) % 64 == 0) { _mm512_stream_ps(rows[i] + c, (__m512)r[i]); continue; }
#endif
                storeu(rows[i] + c, r[i]);
            }
        else
            for (int i = 0; i < count; ++i) store_part(rows[i] + c, r[i], n - c);
    }
}

// Four sums over lanes at once.
P2GS_INLINE F4 sum4(VF a, VF b, VF c, VF d) {
#if defined(__AVX512F__)
    __m512 ab = _mm512_add_ps(_mm512_unpacklo_ps((__m512)a, (__m512)b), _mm512_unpackhi_ps((__m512)a, (__m512)b));
    __m512 cd = _mm512_add_ps(_mm512_unpacklo_ps((__m512)c, (__m512)d), _mm512_unpackhi_ps((__m512)c, (__m512)d));
    __m512 s = _mm512_add_ps(_mm512_shuffle_ps(ab, cd, 0x44), _mm512_shuffle_ps(ab, cd, 0xee));
    __m256 h = _mm256_add_ps(_mm512_castps512_ps256(s), _mm512_extractf32x8_ps(s, 1));
    return (F4)_mm_add_ps(_mm256_castps256_ps128(h), _mm256_extractf128_ps(h, 1));
#elif defined(__AVX2__)
    __m256 ab = _mm256_add_ps(_mm256_unpacklo_ps((__m256)a, (__m256)b), _mm256_unpackhi_ps((__m256)a, (__m256)b));
    __m256 cd = _mm256_add_ps(_mm256_unpacklo_ps((__m256)c, (__m256)d), _mm256_unpackhi_ps((__m256)c, (__m256)d));
    __m256 s = _mm256_add_ps(_mm256_shuffle_ps(ab, cd, 0x44), _mm256_shuffle_ps(ab, cd, 0xee));
    return (F4)_mm_add_ps(_mm256_castps256_ps128(s), _mm256_extractf128_ps(s, 1));
#else
    VF r[4] = {a, b, c, d};
    transpose(r);
    return (r[0] + r[1]) + (r[2] + r[3]);
#endif
}

#if defined(__AVX512F__)
P2GS_INLINE VF select2(VF a, VF b, __m512i lanes) { return (VF)_mm512_permutex2var_ps((__m512)a, lanes, (__m512)b); }
#endif

// out[k] = element k of W consecutive rows of K floats (K = 3 or 4). Of the rows only `count` exist; the others repeat the first.
template <int K>
P2GS_INLINE void load_rows(const float* p, int count, VF* out) {
    alignas(64) float copy[K * W];
    if (count < W) {
        for (int i = 0; i < W; ++i) memcpy(copy + K * i, p + (i < count ? K * i : 0), 4 * K);
        p = copy;
    }
#if defined(__AVX512F__)
    const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    if (K == 3) {
        VF a = loadu(p), b = loadu(p + 16), c = loadu(p + 32);
        for (int k = 0; k < 3; ++k) {  // element 3 i + k: in a up to 15, in b up to 31
            __m512i at = _mm512_add_epi32(_mm512_mullo_epi32(lane, _mm512_set1_epi32(3)), _mm512_set1_epi32(k));
            VF ab = select2(a, b, at);
            __mmask16 late = _mm512_cmpgt_epi32_mask(at, _mm512_set1_epi32(31));
            out[k] = (VF)_mm512_mask_permutexvar_ps((__m512)ab, late, at, (__m512)c);
        }
    } else {
        VF a = loadu(p), b = loadu(p + 16), c = loadu(p + 32), d = loadu(p + 48);
        const __m512i even = _mm512_setr_epi32(0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29);
        const __m512i odd = _mm512_add_epi32(even, _mm512_set1_epi32(2));
        VF ab = select2(a, b, even), cd = select2(c, d, even);
        out[0] = (VF)_mm512_shuffle_f32x4((__m512)ab, (__m512)cd, 0x44);
        out[1] = (VF)_mm512_shuffle_f32x4((__m512)ab, (__m512)cd, 0xee);
        ab = select2(a, b, odd), cd = select2(c, d, odd);
        out[2] = (VF)_mm512_shuffle_f32x4((__m512)ab, (__m512)cd, 0x44);
        out[3] = (VF)_mm512_shuffle_f32x4((__m512)ab, (__m512)cd, 0xee);
    }
#else
    alignas(64) float columns[K][W];
    for (int i = 0; i < W; ++i)
        for (int k = 0; k < K; ++k) columns[k][i] = p[K * i + k];
    for (int k = 0; k < K; ++k) out[k] = load(columns[k]);
#endif
}

// The inverse: the first `count` rows.
template <int K>
P2GS_INLINE void store_rows(float* p, int count, const VF* in) {
    alignas(64) float copy[K * W];
    float* to = count < W ? copy : p;
#if defined(__AVX512F__)
    if (K == 3) {
        alignas(64) static const int32_t xy[48] = {0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5, 21, 0, 6, 22, 0, 7, 23, 0,
                                                   8, 24, 0, 9, 25, 0, 10, 26, 0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0};
        alignas(64) static const int32_t z[48] = {0, 0, 0, 0, 0, 1, 0, 0, 2, 0, 0, 3, 0, 0, 4, 0, 0, 5, 0, 0, 6, 0, 0, 7,
                                                  0, 0, 8, 0, 0, 9, 0, 0, 10, 0, 0, 11, 0, 0, 12, 0, 0, 13, 0, 0, 14, 0, 0, 15};
        const __mmask16 is_z[3] = {0x4924, 0x2492, 0x9249};
        for (int j = 0; j < 3; ++j) {
            VF v = select2(in[0], in[1], _mm512_load_si512(xy + 16 * j));
            storeu(to + 16 * j, (VF)_mm512_mask_permutexvar_ps((__m512)v, is_z[j], _mm512_load_si512(z + 16 * j), (__m512)in[2]));
        }
    } else {
        __m512 a = _mm512_unpacklo_ps((__m512)in[0], (__m512)in[1]), b = _mm512_unpackhi_ps((__m512)in[0], (__m512)in[1]);
        __m512 c = _mm512_unpacklo_ps((__m512)in[2], (__m512)in[3]), d = _mm512_unpackhi_ps((__m512)in[2], (__m512)in[3]);
        __m512 q[4] = {_mm512_shuffle_ps(a, c, 0x44), _mm512_shuffle_ps(a, c, 0xee), _mm512_shuffle_ps(b, d, 0x44),
                       _mm512_shuffle_ps(b, d, 0xee)};  // q[i]: rows i, 4 + i, 8 + i, 12 + i
        __m512 e = _mm512_shuffle_f32x4(q[0], q[1], 0x44), f = _mm512_shuffle_f32x4(q[2], q[3], 0x44);
        __m512 g = _mm512_shuffle_f32x4(q[0], q[1], 0xee), h = _mm512_shuffle_f32x4(q[2], q[3], 0xee);
        storeu(to, (VF)_mm512_shuffle_f32x4(e, f, 0x88));
        storeu(to + 16, (VF)_mm512_shuffle_f32x4(e, f, 0xdd));
        storeu(to + 32, (VF)_mm512_shuffle_f32x4(g, h, 0x88));
        storeu(to + 48, (VF)_mm512_shuffle_f32x4(g, h, 0xdd));
    }
#else
    alignas(64) float columns[K][W];
    for (int k = 0; k < K; ++k) store(columns[k], in[k]);
    for (int i = 0; i < W; ++i)
        for (int k = 0; k < K; ++k) to[K * i + k] = columns[k][i];
#endif
    if (count < W) memcpy(p, copy, 4 * K * count);
}

// out[i] = sum over lanes of v[i], i < 16.
P2GS_INLINE void sum16(const VF* v, float* out) {
#if defined(__AVX512F__)
    __m512 q[4];  // per 128 bits: partial sums of v[4 i .. 4 i + 3]
    for (int i = 0; i < 4; ++i) {
        const __m512 a = (__m512)v[4 * i], b = (__m512)v[4 * i + 1], c = (__m512)v[4 * i + 2], d = (__m512)v[4 * i + 3];
        __m512 ab = _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
        __m512 cd = _mm512_add_ps(_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
        q[i] = _mm512_add_ps(_mm512_shuffle_ps(ab, cd, 0x44), _mm512_shuffle_ps(ab, cd, 0xee));
    }
    __m512 a = _mm512_add_ps(_mm512_shuffle_f32x4(q[0], q[1], 0x44), _mm512_shuffle_f32x4(q[0], q[1], 0xee));
    __m512 b = _mm512_add_ps(_mm512_shuffle_f32x4(q[2], q[3], 0x44), _mm512_shuffle_f32x4(q[2], q[3], 0xee));
    _mm512_store_ps(out, _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xdd)));
#else
    for (int i = 0; i < 16; i += 4) storeu4(out + i, sum4(v[i], v[i + 1], v[i + 2], v[i + 3]));
#endif
}
