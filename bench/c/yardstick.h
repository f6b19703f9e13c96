/* Input, timing and output of the yardsticks. */
#ifndef YARDSTICK_H
#define YARDSTICK_H
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* Numbers separated by white space, or the last column of a CSV file. */
static int read_series(const char *path, double **series)
{
    FILE *file = fopen(path, "r");
    if (!file) {
        perror(path);
        exit(1);
    }
    int n = 0, space = 1024;
    double *y = malloc(space * sizeof *y);
    char line[4096];
    while (fgets(line, sizeof line, file)) {
        char *text = strrchr(line, ',');
        text = text ? text + 1 : line;
        for (;;) {
            char *end;
            double value = strtod(text, &end);
            if (end == text)
                break;
            if (n == space)
                y = realloc(y, (space *= 2) * sizeof *y);
            y[n++] = value;
            text = end;
        }
    }
    fclose(file);
    *series = y;
    return n;
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static int by_size(const void *a, const void *b)
{
    double u = *(const double *)a, v = *(const double *)b;
    return (u > v) - (u < v);
}

/* Seconds and a figure of each of several runs -> "seconds mean error" of one line: the median of
 * the seconds, the mean of the figures and its standard error. */
static inline void report(const char *label, double *seconds, const double *figures, int repeats)
{
    double mean = 0.0, square = 0.0;
    for (int r = 0; r < repeats; r++) {
        double change = figures[r] - mean;
        mean += change / (r + 1);
        square += change * (figures[r] - mean);
    }
    qsort(seconds, repeats, sizeof *seconds, by_size);
    printf("%s %.9g %.9g %.3g\n", label, seconds[repeats / 2], mean,
           sqrt(square / (repeats > 1 ? repeats - 1 : 1) / repeats));
    fflush(stdout);
}

#endif
