/* Fast yardsticks: particle filters in passes over contiguous arrays.
 *
 *   gcc -O3 -march=native -fno-math-errno -fno-trapping-math -ffp-contract=fast filters.c -o filters -lm
 *   ./filters MODEL FILE REPEATS N [N ...]
 *
 * MODEL: varves (bootstrap), lgss (guided: the locally optimal proposal), pendulum (bootstrap, two
 * states, T = the length of FILE), walk2, walk4, walk10 (bootstrap, so many states of which each
 * pulls at the next one; the sum is observed). Their parameters stand below.
 * Systematic resampling at every step. One line for each N: N, seconds of a run (the median), the
 * mean of the log-likelihood estimates and its standard error.
 */
#include "passes.h"
#include "yardstick.h"

typedef double (*filter_t)(rng_t *, const double *, int, long);

static double *x[16], *x_prev[16], *z, *log_w, *w;
static int32_t *ancestors;

static void make_room(long N)
{
    for (int k = 0; k < 16; k++) {
        x[k] = room(N);
        x_prev[k] = room(N);
    }
    z = room(16 * padded(N));
    log_w = room(N);
    w = room(N);
    ancestors = aligned_alloc(64, ((size_t)(padded(N) + 16) * 4 + 63) / 64 * 64);
}

static void drop_room(void)
{
    for (int k = 0; k < 16; k++) {
        free(x[k]);
        free(x_prev[k]);
    }
    free(z);
    free(log_w);
    free(w);
    free(ancestors);
}

static inline void gather(const double *from, double *to, long N)
{
    for (long i = 0; i < N; i++)
        to[i] = from[(uint32_t)ancestors[i]];
}

/* x_1 ~ N(0, 1/((1 - phi^2) tau)), x_t = phi x_{t-1} + N(0, 1/tau), y ~ Gamma(6.25, 0.256 e^-x) */
static double varves(rng_t *g, const double *y, int T, long N)
{
    const double phi = 0.95, tau = 50.0, shape = 6.25, rate = 0.256;
    double sd = 1.0 / sqrt(tau), sd_1 = sd / sqrt(1.0 - phi * phi), total = 0.0, sum = 0.0, top;
    double *now_ = x[0], *before = x_prev[0];
    long P = padded(N);
    for (int t = 0; t < T; t++) {
        double known = shape * log(rate) - lgamma(shape) + (shape - 1.0) * log(y[t]);
        double scaled = rate * y[t], a = t ? phi : 0.0, b = t ? sd : sd_1;
        if (t)
            systematic_values(w, sum, uniform(g), N, now_, before);
        fill_normal(g, z, P);
        for (long i = 0; i < P; i += LANES) {
            vd value = a * *(vd *)(before + i) + b * *(vd *)(z + i);
            *(vd *)(now_ + i) = value;
            *(vd *)(log_w + i) = known - shape * value - scaled * v_exp(-value);
        }
        sum = normalise(log_w, w, N, P, &top);
        total += top + log(sum / N);
    }
    return total;
}

/* x_1 ~ N(0, 1), x_t = 0.9 x_{t-1} + N(0, 0.1), y = x + N(0, 0.1); moves by p(x_t | x_{t-1}, y_t) */
static double lgss(rng_t *g, const double *y, int T, long N)
{
    const double phi = 0.9, q = 0.1, r = 0.1, log_2pi = 1.8378770664093453;
    double total = 0.0, sum = 0.0, top, *now_ = x[0], *before = x_prev[0];
    long P = padded(N);
    for (int t = 0; t < T; t++) {
        double from = t ? q : 1.0, a = t ? phi : 0.0;
        double gain = from / (from + r), sd = sqrt(from * r / (from + r)), s = from + r;
        double known = -0.5 * (log_2pi + log(s)), half = -0.5 / s;
        if (t)
            systematic_values(w, sum, uniform(g), N, now_, before);
        fill_normal(g, z, P);
        for (long i = 0; i < P; i += LANES) {
            vd mean = a * *(vd *)(before + i), off = y[t] - mean;
            *(vd *)(now_ + i) = mean + gain * off + sd * *(vd *)(z + i);
            *(vd *)(log_w + i) = known + half * off * off;
        }
        sum = normalise(log_w, w, N, P, &top);
        total += top + log(sum / N);
    }
    return total;
}

/* angle += 0.05 rate; rate += 0.05 (-9.81 sin(angle) - 0.2 rate) + N(0, 0.1^2);
 * y = angle + N(0, 0.1^2); at first angle ~ N(0.5, 0.1^2), rate ~ N(0, 0.1^2) */
static double pendulum(rng_t *g, const double *y, int T, long N)
{
    const double dt = 0.05, sd = 0.1, noise = 0.1, log_2pi = 1.8378770664093453;
    double total = 0.0, sum = 0.0, top, known = -0.5 * log_2pi - log(noise);
    double half = -0.5 / (noise * noise);
    long P = padded(N);
    for (int t = 0; t < T; t++) {
        if (t) {
            systematic(w, sum, uniform(g), N, ancestors);
            gather(x[0], x_prev[0], N);
            gather(x[1], x_prev[1], N);
            fill_normal(g, z, P);
            for (long i = 0; i < P; i += LANES) {
                vd angle = *(vd *)(x_prev[0] + i), rate = *(vd *)(x_prev[1] + i);
                *(vd *)(x[0] + i) = angle + dt * rate;
                *(vd *)(x[1] + i) =
                    rate + dt * (-9.81 * v_sin(angle) - 0.2 * rate) + sd * *(vd *)(z + i);
            }
        } else {
            fill_normal(g, z, 2 * P);
            for (long i = 0; i < P; i++) {
                x[0][i] = 0.5 + 0.1 * z[i];
                x[1][i] = 0.1 * z[P + i];
            }
        }
        for (long i = 0; i < P; i += LANES) {
            vd off = y[t] - *(vd *)(x[0] + i);
            *(vd *)(log_w + i) = known + half * off * off;
        }
        sum = normalise(log_w, w, N, P, &top);
        total += top + log(sum / N);
    }
    return total;
}

/* x_k' = 0.8 x_k + 0.1 x_{k+1} + N(0, 0.3^2), round in a ring, from N(0, 1); y = sum x + N(0, 1) */
static inline double walk(rng_t *g, const double *y, int T, long N, int D)
{
    const double log_2pi = 1.8378770664093453;
    double total = 0.0, sum = 0.0, top, known = -0.5 * log_2pi;
    long P = padded(N);
    for (int t = 0; t < T; t++) {
        if (t) {
            systematic(w, sum, uniform(g), N, ancestors);
            for (int k = 0; k < D; k++)
                gather(x[k], x_prev[k], N);
        }
        fill_normal(g, z, D * P);
        for (long i = 0; i < P; i += LANES) {
            vd level = all(0.0);
            for (int k = 0; k < D; k++) {
                vd e = *(vd *)(z + k * P + i);
                vd mean = 0.8 * *(vd *)(x_prev[k] + i) + 0.1 * *(vd *)(x_prev[(k + 1) % D] + i);
                vd value = (t ? 1.0 : 0.0) * mean + (t ? 0.3 : 1.0) * e;
                *(vd *)(x[k] + i) = value;
                level += value;
            }
            vd off = y[t] - level;
            *(vd *)(log_w + i) = known - 0.5 * off * off;
        }
        sum = normalise(log_w, w, N, P, &top);
        total += top + log(sum / N);
    }
    return total;
}

static double walk2(rng_t *g, const double *y, int T, long N) { return walk(g, y, T, N, 2); }
static double walk4(rng_t *g, const double *y, int T, long N) { return walk(g, y, T, N, 4); }
static double walk10(rng_t *g, const double *y, int T, long N) { return walk(g, y, T, N, 10); }

int main(int argc, char **argv)
{
    static const struct { const char *name; filter_t run; } known[] = {
        {"varves", varves}, {"lgss", lgss}, {"pendulum", pendulum},
        {"walk2", walk2}, {"walk4", walk4}, {"walk10", walk10}};
    filter_t run = NULL;
    for (size_t k = 0; argc > 4 && k < sizeof known / sizeof *known; k++)
        if (!strcmp(argv[1], known[k].name))
            run = known[k].run;
    if (!run) {
        fprintf(stderr, "usage: %s MODEL FILE REPEATS N [N ...]\n", argv[0]);
        return 2;
    }
    double *y;
    int T = read_series(argv[2], &y), repeats = atoi(argv[3]);
    rng_t g;
    seed_rng(&g, (uint64_t)(1e9 * now()));
    double *seconds = malloc(repeats * sizeof *seconds), *found = malloc(repeats * sizeof *found);
    for (int k = 4; k < argc; k++) {
        long N = atol(argv[k]);
        make_room(N);
        run(&g, y, T, N); /* touches all pages */
        for (int r = 0; r < repeats; r++) {
            double start = now();
            found[r] = run(&g, y, T, N);
            seconds[r] = now() - start;
        }
        report(argv[k], seconds, found, repeats);
        drop_room();
    }
    return 0;
}
