// Between rows in memory and columns in vectors, and sums over lanes. Included behind simd.h.

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
