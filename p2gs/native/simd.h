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

// While one lives, results too small for a normal float are zero. On many machines each step in the subnormal range costs a hundred
// others, and some numbers get there: products of finished pixels, gradients of parts that are as good as ruled out.
struct FlushSubnormals {
#if defined(__SSE2__)
    unsigned before = _mm_getcsr();
    FlushSubnormals() { _mm_setcsr(before | 0x8040); }
    ~FlushSubnormals() { _mm_setcsr(before); }
#else
    ~FlushSubnormals() {}
#endif
};

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
