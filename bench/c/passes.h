/* Passes over particles, a vector register at a time: what the fast yardsticks are made of.
 *
 * Written with GCC's vector types, of eight numbers with AVX-512 and of four without. Everything is
 * in double precision; exp, log, sine and cosine are polynomials with an error of a few units in
 * the last place. Arrays are padded to a multiple of two registers; `N` is the number of particles,
 * `P` that number padded.
 *
 *   words     xoshiro256++ generators side by side (Blackman and Vigna, ACM TOMS 47, 2021)
 *   normals   Box and Muller (1958), both of a pair
 *   resample  systematic, by the number of copies of each particle: no branch that data decide
 */
#ifndef PASSES_H
#define PASSES_H
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#ifdef __AVX512F__
#define LANES 8
#else
#define LANES 4
#endif
typedef double vd __attribute__((vector_size(8 * LANES), aligned(8 * LANES), may_alias));
typedef uint64_t vu __attribute__((vector_size(8 * LANES), aligned(8 * LANES), may_alias));
typedef int64_t vi __attribute__((vector_size(8 * LANES), aligned(8 * LANES), may_alias));

static inline vd all(double x) { return x - (vd){0.0}; }
static inline vd choose(vi mask, vd yes, vd no)
{
    return (vd)(((vi)yes & mask) | ((vi)no & ~mask));
}

/* ---- elementary functions ---- */

/* exp(x) for x <= 700; exactly 0 below -708, -inf included. */
static inline vd v_exp(vd x)
{
    const double shift = 0x1.8p52;
    vd n = x * 1.4426950408889634 + shift;
    vi k = (vi)n << 52;
    n -= shift;
    vd r = x - n * 6.93147180369123816490e-01;
    r = r - n * 1.90821492927058770002e-10;
    vd p = all(1.0 / 479001600.0); /* Taylor: |r| <= 0.35 */
    p = p * r + 1.0 / 39916800.0;
    p = p * r + 1.0 / 3628800.0;
    p = p * r + 1.0 / 362880.0;
    p = p * r + 1.0 / 40320.0;
    p = p * r + 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    vd value = (vd)((vi)p + k);
    return choose(x < -708.0, all(0.0), value);
}

/* log(x) for ordinary x > 0. */
static inline vd v_log(vd x)
{
    vi bits = (vi)x;
    vi k = (bits - 0x3fe6a09e667f3bcdLL) >> 52; /* so that the rest is in [sqrt 1/2, sqrt 2) */
    vd m = (vd)(bits - (k << 52));
    vd e = (vd)(k + 0x4338000000000000LL) - 0x1.8p52;
    vd s = (m - 1.0) / (m + 1.0), z = s * s;
    vd p = all(1.0 / 19.0);
    p = p * z + 1.0 / 17.0;
    p = p * z + 1.0 / 15.0;
    p = p * z + 1.0 / 13.0;
    p = p * z + 1.0 / 11.0;
    p = p * z + 1.0 / 9.0;
    p = p * z + 1.0 / 7.0;
    p = p * z + 1.0 / 5.0;
    p = p * z + 1.0 / 3.0;
    return e * 6.931471805599453e-01 + (2.0 * s + 2.0 * s * z * p);
}

/* Sine and cosine of x in [-pi/4, pi/4]. */
static inline void v_sin_cos_small(vd x, vd *sine, vd *cosine)
{
    vd z = x * x;
    vd p = all(1.0 / 1307674368000.0) * -1.0;
    p = p * z + 1.0 / 6227020800.0;
    p = p * z - 1.0 / 39916800.0;
    p = p * z + 1.0 / 362880.0;
    p = p * z - 1.0 / 5040.0;
    p = p * z + 1.0 / 120.0;
    p = p * z - 1.0 / 6.0;
    *sine = x + x * z * p;
    vd q = all(1.0 / 20922789888000.0);
    q = q * z - 1.0 / 87178291200.0;
    q = q * z + 1.0 / 479001600.0;
    q = q * z - 1.0 / 3628800.0;
    q = q * z + 1.0 / 40320.0;
    q = q * z - 1.0 / 720.0;
    q = q * z + 1.0 / 24.0;
    *cosine = 1.0 - 0.5 * z + z * z * q;
}

/* sin(x) for |x| below some thousands. */
static inline vd v_sin(vd x)
{
    const double shift = 0x1.8p52;
    vd n = x * 0.6366197723675814 + shift;
    vi quadrant = (vi)n;
    n -= shift;
    vd r = x - n * 1.57079632673412561417e+00, s, c;
    r = r - n * 6.07710050650619224932e-11;
    v_sin_cos_small(r, &s, &c);
    vd value = choose((quadrant & 1) != 0, c, s);
    return (vd)((vi)value ^ ((quadrant & 2) << 62));
}

/* ---- random numbers ---- */

typedef struct { vu s[4]; } rng_t;

static void seed_rng(rng_t *g, uint64_t seed)
{
    for (int k = 0; k < 4; k++)
        for (int lane = 0; lane < LANES; lane++) { /* SplitMix64 */
            uint64_t z = (seed += 0x9E3779B97F4A7C15u);
            z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
            z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
            g->s[k][lane] = z ^ (z >> 31);
        }
}

static inline vu v_word(vu s[4])
{
    vu sum = s[0] + s[3];
    vu result = ((sum << 23) | (sum >> 41)) + s[0], t = s[1] << 17;
    s[2] ^= s[0];
    s[3] ^= s[1];
    s[1] ^= s[2];
    s[0] ^= s[3];
    s[2] ^= t;
    s[3] = (s[3] << 45) | (s[3] >> 19);
    return result;
}

/* In (0, 1): the upper 52 bits and a half. */
static inline vd v_unit(vu word)
{
    return (vd)((word >> 12) | 0x3ff0000000000000u) - (1.0 - 0x1p-53);
}

static inline double uniform(rng_t *g)
{
    vd u = v_unit(v_word(g->s));
    return u[0];
}

/* Standard normals, `count` of them and up to 15 more. */
static inline void fill_normal(rng_t *g, double *out, long count)
{
    vu s[4] = {g->s[0], g->s[1], g->s[2], g->s[3]};
    for (long i = 0; i < count; i += 2 * LANES) {
        vu angle = v_word(s);
        vd size = -2.0 * v_log(v_unit(v_word(s))), radius, a, b;
        for (int lane = 0; lane < LANES; lane++)
            radius[lane] = __builtin_sqrt(size[lane]);
        v_sin_cos_small(1.5707963267948966 * (v_unit(angle) - 0.5), &a, &b);
        /* The lowest bits, which `v_unit` does not use, choose among the four quadrants. */
        b = (vd)((vu)b ^ (angle << 63));
        vi turned = (vi)(angle & 2) != 0;
        *(vd *)(out + i) = radius * choose(turned, a, b);
        *(vd *)(out + i + LANES) = radius * choose(turned, b, a);
    }
    memcpy(g->s, s, sizeof s);
}

/* ---- weights ---- */

/* log_w -> w = exp(log_w - max), padded with 0; returns the sum of w, and the maximum. */
static inline double normalise(double *log_w, double *w, long N, long P, double *largest)
{
    for (long i = N; i < P; i++)
        log_w[i] = -INFINITY;
    vd top = all(-INFINITY);
    for (long i = 0; i < P; i += LANES) {
        vd v = *(vd *)(log_w + i);
        top = choose(v > top, v, top);
    }
    double highest = top[0];
    for (int lane = 1; lane < LANES; lane++)
        highest = top[lane] > highest ? top[lane] : highest;
    vd total = all(0.0);
    for (long i = 0; i < P; i += LANES) {
        vd v = v_exp(*(vd *)(log_w + i) - highest);
        *(vd *)(w + i) = v;
        total += v;
    }
    double sum = 0.0;
    for (int lane = 0; lane < LANES; lane++)
        sum += total[lane];
    *largest = highest;
    return sum;
}

/* The ancestors of N particles: `ancestors` has room for N + 4. */
static inline void systematic(const double *w, double sum, double u, long N, int32_t *ancestors)
{
    double s = 1.0 - u, scale = N / sum;
    long p = 0;
    for (long j = 0; j < N; j++) {
        s += w[j] * scale;
        long q = (long)s;
        q = q < N ? q : N;
        int32_t *to = ancestors + p;
        to[0] = to[1] = to[2] = to[3] = (int32_t)j;
        for (long k = p + 4; k < q; k++)
            ancestors[k] = (int32_t)j;
        p = q;
    }
    for (; p < N; p++)
        ancestors[p] = (int32_t)(N - 1);
}

/* The same for a single state, which is copied itself. */
static inline void systematic_values(
    const double *w, double sum, double u, long N, const double *x, double *out)
{
    double s = 1.0 - u, scale = N / sum;
    long p = 0;
    for (long j = 0; j < N; j++) {
        s += w[j] * scale;
        long q = (long)s;
        q = q < N ? q : N;
        double *to = out + p;
        to[0] = to[1] = to[2] = to[3] = x[j];
        for (long k = p + 4; k < q; k++)
            out[k] = x[j];
        p = q;
    }
    for (; p < N; p++)
        out[p] = x[N - 1];
}

static inline long padded(long N) { return (N + 2 * LANES - 1) / (2 * LANES) * (2 * LANES); }

/* Room for `count` doubles, aligned, zero, with some more behind. */
static double *room(long count)
{
    size_t bytes = (size_t)(padded(count) + 2 * LANES) * sizeof(double);
    void *p = aligned_alloc(64, (bytes + 63) / 64 * 64);
    memset(p, 0, bytes);
    return p;
}

#endif
