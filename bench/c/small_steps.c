/* Yardstick: small Runge-Kutta steps of a pendulum in plain C, for many particles and rows.
 *
 *   q'' = u - k sin q - d q',   classical Runge-Kutta, STEPS steps of H / STEPS in each row.
 *
 *   gcc -O3 -march=native small_steps.c -o small_steps -lm
 *   ./small_steps PARTICLES ROWS STEPS REPEATS
 *
 * Output: "loop", the seconds of all rows (the median over the repeats) and the mean of q at the
 * end, with 0 for its error.
 */
#include "yardstick.h"

#define H 0.05

int main(int argc, char **argv)
{
    int n = argc > 1 ? atoi(argv[1]) : 1000, rows = argc > 2 ? atoi(argv[2]) : 700;
    int steps = argc > 3 ? atoi(argv[3]) : 25, repeats = argc > 4 ? atoi(argv[4]) : 5;
    double k = 9.0, d = 0.5, h = H / steps;
    double *q = malloc(n * sizeof *q), *v = malloc(n * sizeof *v);
    double *seconds = malloc(repeats * sizeof *seconds), *ends = malloc(repeats * sizeof *ends);
    for (int r = 0; r < repeats; r++) {
        for (int i = 0; i < n; i++) {
            q[i] = -0.2 + 0.4 * i / n;
            v[i] = 0.1;
        }
        double begun = now();
        for (int t = 0; t < rows; t++) {
            double u = 0.5 * sin(0.1 * t);
            for (int i = 0; i < n; i++) {
                double x = q[i], w = v[i];
                for (int j = 0; j < steps; j++) {
                    double a1 = w, b1 = u - k * sin(x) - d * w;
                    double a2 = w + 0.5 * h * b1, b2 = u - k * sin(x + 0.5 * h * a1) - d * a2;
                    double a3 = w + 0.5 * h * b2, b3 = u - k * sin(x + 0.5 * h * a2) - d * a3;
                    double a4 = w + h * b3, b4 = u - k * sin(x + h * a3) - d * a4;
                    x += h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4);
                    w += h / 6.0 * (b1 + 2.0 * (b2 + b3) + b4);
                }
                q[i] = x;
                v[i] = w;
            }
        }
        seconds[r] = now() - begun;
        ends[r] = 0.0;
        for (int i = 0; i < n; i++)
            ends[r] += q[i] / n;
    }
    report("loop", seconds, ends, repeats);
    return 0;
}
