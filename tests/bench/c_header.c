/* How long an exported header takes, on one core: ns per point, ms per map in strips, ms per whole map, ms per memset of
 * as much memory, ns per sample. The best of some rounds each, since the machine may be busy. */
#define _POSIX_C_SOURCE 200809L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "drift.h"

enum { POINTS = 1000, ROUNDS = 25, STRIP = 32 };

static double now_s(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static double least(double one, double other) { return one < other ? one : other; }

int main(void) {
    const size_t pixels = (size_t)DRIFT_WIDTH * DRIFT_HEIGHT;
    static double points[2 * POINTS], corrected[2 * POINTS];
    static unsigned char flags[POINTS];
    double point_s = 1e9, strips_s = 1e9, map_s = 1e9, memory_s = 1e9, sample_s = 1e9, sum = 0.0, begin_s;
    float *map_x = malloc(pixels * sizeof *map_x), *map_y = malloc(pixels * sizeof *map_y);
    drift_state state;
    int k, round, y;
    drift_init(&state);
    for (k = 0; k < 2 * POINTS; ++k) points[k] = 100 + (k * 37) % 1800;
    for (round = 0; round < ROUNDS; ++round) {
        begin_s = now_s();
        for (k = 0; k < 1000; ++k) drift_advance(&state, 10.0, 24.0, 1.0, 44.0);
        sample_s = least(sample_s, (now_s() - begin_s) / 1000);
        begin_s = now_s();
        drift_correct(&state, points, corrected, flags, POINTS);
        point_s = least(point_s, (now_s() - begin_s) / POINTS);
        sum += corrected[round];
        begin_s = now_s();
        for (y = 0; y < DRIFT_HEIGHT; y += STRIP) {
            drift_map(&state, y, STRIP < DRIFT_HEIGHT - y ? STRIP : DRIFT_HEIGHT - y, map_x, map_y);
            sum += (double)map_x[y];
        }
        strips_s = least(strips_s, now_s() - begin_s);
        begin_s = now_s();
        drift_map(&state, 0, DRIFT_HEIGHT, map_x, map_y);
        map_s = least(map_s, now_s() - begin_s);
        sum += (double)map_y[round];
        begin_s = now_s();
        memset(map_x, round, pixels * sizeof *map_x);
        memset(map_y, round, pixels * sizeof *map_y);
        memory_s = least(memory_s, now_s() - begin_s);
        sum += (double)map_y[round];
    }
    printf("%g %g %g %g %g\n", 1e9 * point_s, 1e3 * strips_s, 1e3 * map_s, 1e3 * memory_s, 1e9 * sample_s);
    free(map_x);
    free(map_y);
    return sum > 1e300;
}
