/* Yardstick: a bootstrap particle filter in plain C, as one would write it by hand.
 *
 * Model (ice varves):  x_1 ~ N(0, 1/((1 - phi^2) tau)),   x_t = phi x_{t-1} + N(0, 1/tau),
 *                      y_t ~ Gamma(shape 6.25, rate 0.256 exp(-x_t)).
 * Systematic resampling at every step; resampling, propagation and log-density in one loop over
 * the particles; libm's exp.  Normals: ziggurat of 128 layers (G. Marsaglia, W. W. Tsang,
 * J. Stat. Soft. 5(8), 2000) over xoshiro256++ (D. Blackman, S. Vigna, ACM TOMS 47, 2021).
 *
 *   gcc -O3 -march=native bootstrap_varves.c -o bootstrap_varves -lm
 *   ./bootstrap_varves FILE [REPEATS [PHI [TAU]]]
 *
 * FILE: the observations, separated by white space, or a CSV file with the header time,y.
 * Output: one line for each N with ns per particle and step (the median over the repeats) and
 * the mean of the log-likelihood estimates with its standard error.
 */
#include "yardstick.h"

#include <stdint.h>

#define SHAPE 6.25
#define RATE 0.256

/* ---- random numbers ---- */

typedef struct { uint64_t s[4]; } rng_t;

static inline uint64_t rotl(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

static inline uint64_t next_word(rng_t *g)
{
    uint64_t *s = g->s;
    uint64_t result = rotl(s[0] + s[3], 23) + s[0];
    uint64_t t = s[1] << 17;
    s[2] ^= s[0];
    s[3] ^= s[1];
    s[1] ^= s[2];
    s[0] ^= s[3];
    s[2] ^= t;
    s[3] = rotl(s[3], 45);
    return result;
}

static void seed_rng(rng_t *g, uint64_t seed)
{
    for (int i = 0; i < 4; i++) { /* SplitMix64 */
        uint64_t z = (seed += 0x9E3779B97F4A7C15u);
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        g->s[i] = z ^ (z >> 31);
    }
}

/* A uniform in (0, 1): 52 bits and a half. */
static inline double uniform(rng_t *g) { return ((next_word(g) >> 12) + 0.5) * 0x1p-52; }

#define LAYERS 128
#define TAIL 3.442619855899     /* where the tail begins, for 128 layers */
#define AREA 9.91256303526217e-3 /* of each layer */
static double zig_x[LAYERS + 1], zig_ratio[LAYERS], zig_f[LAYERS + 1];

static void make_ziggurat(void)
{
    zig_x[0] = AREA / exp(-0.5 * TAIL * TAIL); /* the width that the bottom layer would have */
    zig_x[1] = TAIL;
    for (int i = 2; i < LAYERS; i++) {
        double below = zig_x[i - 1];
        zig_x[i] = sqrt(-2.0 * log(AREA / below + exp(-0.5 * below * below)));
    }
    zig_x[LAYERS] = 0.0;
    for (int i = 0; i < LAYERS; i++)
        zig_ratio[i] = zig_x[i + 1] / zig_x[i];
    for (int i = 0; i <= LAYERS; i++)
        zig_f[i] = exp(-0.5 * zig_x[i] * zig_x[i]);
}

static inline double normal(rng_t *g)
{
    for (;;) {
        uint64_t w = next_word(g);
        int i = (int)(w & (LAYERS - 1));
        /* The upper 53 bits as a number in [-1, 1); the layer uses other bits. */
        double u = (double)((int64_t)w >> 11) * 0x1p-52;
        if (fabs(u) < zig_ratio[i])
            return u * zig_x[i];
        if (i == 0) {
            double x, y;
            do {
                x = -log(uniform(g)) / TAIL;
                y = -log(uniform(g));
            } while (2.0 * y < x * x);
            return u < 0.0 ? -(TAIL + x) : TAIL + x;
        }
        double x = u * zig_x[i];
        if (zig_f[i] + uniform(g) * (zig_f[i + 1] - zig_f[i]) < exp(-0.5 * x * x))
            return x;
    }
}

/* ---- the filter ---- */

static double filter(rng_t *g, const double *y, int T, int N, double phi, double tau, double *x,
                     double *x_next, double *log_w, double *w)
{
    double sd = 1.0 / sqrt(tau), sd_1 = sd / sqrt(1.0 - phi * phi);
    double log_likelihood = 0.0, total = 0.0;
    for (int t = 0; t < T; t++) {
        double constant = SHAPE * log(RATE) - lgamma(SHAPE) + (SHAPE - 1.0) * log(y[t]);
        double scaled = RATE * y[t], top = -INFINITY;
        double sum = 0.0, step = total / N, point = t > 0 ? uniform(g) * step : 0.0;
        int j = 0;
        if (t > 0)
            sum = w[0];
        for (int i = 0; i < N; i++) {
            double value;
            if (t == 0) {
                value = sd_1 * normal(g);
            } else {
                while (point > sum && j < N - 1)
                    sum += w[++j];
                point += step;
                value = phi * x[j] + sd * normal(g);
            }
            x_next[i] = value;
            log_w[i] = constant - SHAPE * value - scaled * exp(-value);
            if (log_w[i] > top)
                top = log_w[i];
        }
        total = 0.0;
        for (int i = 0; i < N; i++)
            total += w[i] = exp(log_w[i] - top);
        log_likelihood += top + log(total / N);
        double *swap = x;
        x = x_next;
        x_next = swap;
    }
    return log_likelihood;
}

int main(int argc, char **argv)
{
    if (argc < 2) {
        fprintf(stderr, "usage: %s FILE [REPEATS [PHI [TAU]]]\n", argv[0]);
        return 2;
    }
    int repeats = argc > 2 ? atoi(argv[2]) : 50;
    double phi = argc > 3 ? atof(argv[3]) : 0.95, tau = argc > 4 ? atof(argv[4]) : 50.0;
    double *y;
    int T = read_series(argv[1], &y);
    if (T < 1 || repeats < 2) {
        fprintf(stderr, "no observations in %s, or fewer than 2 repeats\n", argv[1]);
        return 2;
    }
    make_ziggurat();
    rng_t g;
    seed_rng(&g, 1);
    double *seconds = malloc(repeats * sizeof *seconds);
    for (int N = 100; N <= 10000; N *= 10) {
        double *work = malloc(4 * (size_t)N * sizeof *work), mean = 0.0, square = 0.0;
        for (int r = 0; r < repeats; r++) {
            double start = now();
            double z = filter(&g, y, T, N, phi, tau, work, work + N, work + 2 * N, work + 3 * N);
            seconds[r] = now() - start;
            double change = z - mean;
            mean += change / (r + 1);
            square += change * (z - mean);
        }
        qsort(seconds, repeats, sizeof *seconds, by_size);
        printf("N = %5d  %6.2f ns per particle step  log-likelihood %.3f +- %.3f  (T = %d)\n", N,
               seconds[repeats / 2] / ((double)T * N) * 1e9, mean,
               sqrt(square / (repeats - 1) / repeats), T);
        free(work);
    }
    free(seconds);
    free(y);
    return 0;
}
