/* Fast yardsticks on the ice varves: conditional SMC with ancestor sampling, and FFBSi.
 *
 *   gcc -O3 -march=native -fno-math-errno -fno-trapping-math -ffp-contract=fast smoothers.c -o smoothers -lm
 *   ./smoothers csmc FILE SWEEPS N [N ...]
 *   ./smoothers ffbsi FILE REPEATS N M
 *
 * csmc: the kernel of PGAS (Lindsten, Jordan and Schön 2014) with conditional systematic
 * resampling (Chopin and Singh 2015), at fixed parameters. One line for each N: N, seconds of a
 * sweep (the median of blocks of 20), the mean of x_T/2 over all sweeps, and an error that takes
 * blocks of 20 sweeps for independent. ffbsi: M trajectories by backward simulation with exact
 * weights (Godsill, Doucet and West 2004), the filter of N particles included.
 */
#include "passes.h"
#include "yardstick.h"

static const double PHI = 0.95, TAU = 50.0, SHAPE = 6.25, RATE = 0.256;

static inline void weigh(const double *x, double y, double *log_w, long P)
{
    double known = SHAPE * log(RATE) - lgamma(SHAPE) + (SHAPE - 1.0) * log(y), scaled = RATE * y;
    for (long i = 0; i < P; i += LANES) {
        vd v = *(vd *)(x + i);
        *(vd *)(log_w + i) = known - SHAPE * v - scaled * v_exp(-v);
    }
}

/* log_v = log f(next | x) up to a constant that is the same for all. */
static inline void weigh_next(const double *x, double next, double *log_v, long P)
{
    for (long i = 0; i < P; i += LANES) {
        vd off = next - PHI * *(vd *)(x + i);
        *(vd *)(log_v + i) = -0.5 * TAU * off * off;
    }
}

static inline long draw_index(const double *w, long N, double u)
{
    double total = 0.0;
    for (long j = 0; j < N; j++)
        if ((total += w[j]) > u)
            return j;
    return N - 1;
}

static double *history, *z, *log_w, *w, *v;
static int32_t *ancestry;

/* Systematic ancestors given that particle N - 1 has ancestor `keep`: the comb is moved so that
 * one of its teeth, uniform on the stretch of `keep`, falls to that particle. */
static void conditional_systematic(
    rng_t *g, const double *p, double sum, long keep, long N, int32_t *ancestors)
{
    double scale = N / sum, low = 0.0, high, tooth;
    for (long j = 0; j < keep; j++)
        low += p[j];
    low *= scale;
    high = low + p[keep] * scale;
    tooth = low + uniform(g) * (high - low);
    systematic(p, sum, tooth - floor(tooth), N, ancestors);
    /* One of the copies of `keep` goes to the end; the order of the others does not matter. */
    long at = 0;
    while (at < N - 1 && ancestors[at] != keep)
        at++;
    int32_t last = ancestors[N - 1];
    ancestors[N - 1] = (int32_t)keep;
    if (at < N - 1)
        ancestors[at] = last;
}

static void sweep(rng_t *g, const double *y, int T, long N, double *path)
{
    double sd = 1.0 / sqrt(TAU), sd_1 = sd / sqrt(1.0 - PHI * PHI), sum = 0.0, top;
    long P = padded(N);
    for (int t = 0; t < T; t++) {
        double *x = history + t * P, *before = x - P;
        fill_normal(g, z, P);
        if (t) {
            int32_t *ancestors = ancestry + t * (P + 16);
            weigh_next(before, path[t], v, P);
            for (long i = 0; i < P; i += LANES)
                *(vd *)(v + i) = *(vd *)(w + i) * v_exp(*(vd *)(v + i));
            double total = 0.0;
            for (long i = 0; i < N; i++)
                total += v[i];
            long keep = draw_index(v, N, uniform(g) * total);
            conditional_systematic(g, w, sum, keep, N, ancestors);
            for (long i = 0; i < N; i++)
                x[i] = PHI * before[ancestors[i]] + sd * z[i];
        } else {
            for (long i = 0; i < N; i++)
                x[i] = sd_1 * z[i];
        }
        x[N - 1] = path[t];
        weigh(x, y[t], log_w, P);
        sum = normalise(log_w, w, N, P, &top);
    }
    long k = draw_index(w, N, uniform(g) * sum);
    for (int t = T - 1; t >= 0; t--) {
        path[t] = history[t * P + k];
        if (t)
            k = ancestry[t * (P + 16) + k];
    }
}

static void ffbsi(rng_t *g, const double *y, int T, long N, long M, double *paths)
{
    double sd = 1.0 / sqrt(TAU), sd_1 = sd / sqrt(1.0 - PHI * PHI), top, sum = 0.0;
    long P = padded(N);
    double *weights = room((long)T * P);
    for (int t = 0; t < T; t++) {
        double *x = history + t * P;
        fill_normal(g, z, P);
        if (t)
            systematic_values(weights + (t - 1) * P, sum, uniform(g), N, x - P, v);
        for (long i = 0; i < P; i += LANES)
            *(vd *)(x + i) = t ? PHI * *(vd *)(v + i) + sd * *(vd *)(z + i)
                               : sd_1 * *(vd *)(z + i);
        weigh(x, y[t], log_w, P);
        sum = normalise(log_w, weights + t * P, N, P, &top);
    }
    double *chance = room(P);
    for (long m = 0; m < M; m++) {
        double *last = weights + (T - 1) * P;
        double next = history[(T - 1) * P + draw_index(last, N, uniform(g) * sum)];
        paths[m * T + T - 1] = next;
        for (int t = T - 2; t >= 0; t--) {
            double *x = history + t * P, *own = weights + t * P;
            vd total = all(0.0);
            for (long i = 0; i < P; i += LANES) {
                vd off = next - PHI * *(vd *)(x + i);
                vd p = *(vd *)(own + i) * v_exp(-0.5 * TAU * off * off);
                *(vd *)(chance + i) = p;
                total += p;
            }
            double whole = 0.0;
            for (int lane = 0; lane < LANES; lane++)
                whole += total[lane];
            next = x[draw_index(chance, N, uniform(g) * whole)];
            paths[m * T + t] = next;
        }
    }
    free(chance);
    free(weights);
}

int main(int argc, char **argv)
{
    if (argc < 5 || (argv[1][0] == 'f' && argc < 6)) {
        fprintf(stderr, "usage: %s csmc FILE SWEEPS N [N ...] | ffbsi FILE REPEATS N M\n", argv[0]);
        return 2;
    }
    double *y;
    int T = read_series(argv[2], &y), repeats = atoi(argv[3]);
    rng_t g;
    seed_rng(&g, (uint64_t)(1e9 * now()));
    int csmc = !strcmp(argv[1], "csmc"), block = csmc ? 20 : 1, blocks = repeats / block;
    double *seconds = malloc(blocks * sizeof *seconds), *found = malloc(blocks * sizeof *found);
    for (int k = 4; k < (csmc ? argc : 5); k++) {
        long N = atol(argv[k]), P = padded(N), M = csmc ? 1 : atol(argv[5]);
        history = room((long)T * P);
        ancestry = malloc((size_t)T * (P + 16) * sizeof *ancestry);
        z = room(P);
        log_w = room(P);
        w = room(P);
        v = room(P);
        double *path = room((long)T * M);
        if (csmc)
            for (int t = 0; t < T; t++) /* begins where the data are likely */
                path[t] = log(RATE * y[t] / SHAPE);
        for (int b = -5; b < blocks; b++) {
            double start = now(), mean = 0.0;
            for (int r = 0; r < block; r++) {
                if (csmc)
                    sweep(&g, y, T, N, path);
                else
                    ffbsi(&g, y, T, N, M, path);
                for (long m = 0; m < M; m++)
                    mean += path[m * T + T / 2] / (M * block);
            }
            if (b >= 0) {
                seconds[b] = (now() - start) / block;
                found[b] = mean;
            }
        }
        report(argv[k], seconds, found, blocks);
        free(history);
        free(ancestry);
    }
    return 0;
}
