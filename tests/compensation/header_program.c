/* Follows a camera through samples with an exported header, and writes what the header says after each.
 *
 * Standard input, doubles: the count of points, x and y of each, then samples (dt_s, ambient_degC, power_on, camera_degC).
 * Standard output, doubles after each sample: flags of the state, x and y of each corrected point, flags of each, x and
 * y of each displacement in single precision. At the end the two maps go to the file that is named, as floats.
 */
#include <stdio.h>
#include <stdlib.h>
#include "drift.h"

static float map_x[DRIFT_WIDTH * DRIFT_HEIGHT], map_y[DRIFT_WIDTH * DRIFT_HEIGHT];

int main(int count_of_arguments, char **arguments) {
    double count = 0, sample[4], *points, *corrected, *in_place;
    unsigned char *flags, *flags_f32;
    float *points_f32, *corrected_f32;
    size_t n, points_read, flagged;
    drift_state state;
    FILE *file;
    if (count_of_arguments != 2 || fread(&count, sizeof count, 1, stdin) != 1) return 2;
    points_read = (size_t)count;
    points = malloc(2 * points_read * sizeof *points);
    corrected = malloc(2 * points_read * sizeof *corrected);
    in_place = malloc(2 * points_read * sizeof *in_place);
    points_f32 = malloc(2 * points_read * sizeof *points_f32);
    corrected_f32 = malloc(2 * points_read * sizeof *corrected_f32);
    flags = malloc(points_read);
    flags_f32 = malloc(points_read);
    if (fread(points, sizeof *points, 2 * points_read, stdin) != 2 * points_read) return 2;
    for (n = 0; n < 2 * points_read; ++n) points_f32[n] = points[n] < 1e30 && points[n] > -1e30 ? (float)points[n] : NAN;
    drift_init(&state);
    while (fread(sample, sizeof sample, 1, stdin) == 1) {
        double own = drift_advance(&state, sample[0], sample[1], sample[2], sample[3]);
        flagged = drift_correct(&state, points, corrected, flags, points_read);
        for (n = 0; n < points_read; ++n) flagged -= flags[n] != 0;
        if (flagged != 0) return 3;
        memcpy(in_place, points, 2 * points_read * sizeof *points);
        drift_correct(&state, in_place, in_place, NULL, points_read);
        if (memcmp(in_place, corrected, 2 * points_read * sizeof *points) != 0) return 5;
        drift_correct_f32(&state, points_f32, corrected_f32, flags_f32, points_read);
        fwrite(&own, sizeof own, 1, stdout);
        fwrite(corrected, sizeof *corrected, 2 * points_read, stdout);
        for (n = 0; n < points_read; ++n) {
            double one = flags[n];
            fwrite(&one, sizeof one, 1, stdout);
        }
        for (n = 0; n < points_read; ++n) {
            float shift_f32[2];
            double shift[2];
            drift_shift_f32(&state, points_f32[2 * n], points_f32[2 * n + 1], shift_f32);
            shift[0] = (double)shift_f32[0];
            shift[1] = (double)shift_f32[1];
            fwrite(shift, sizeof shift, 1, stdout);
        }
    }
    if (drift_map(&state, -1, 1, map_x, map_y) != -1 || drift_map(&state, 1, DRIFT_HEIGHT, map_x, map_y) != -1) return 4;
    if (drift_map(&state, 0, 7, map_x, map_y) >= 0) {
        drift_map(&state, 7, DRIFT_HEIGHT - 7, map_x + 7 * DRIFT_WIDTH, map_y + 7 * DRIFT_WIDTH);
    }
    file = fopen(arguments[1], "wb");
    if (!file) return 2;
    fwrite(map_x, sizeof *map_x, DRIFT_WIDTH * DRIFT_HEIGHT, file);
    fwrite(map_y, sizeof *map_y, DRIFT_WIDTH * DRIFT_HEIGHT, file);
    fclose(file);
    free(points);
    free(corrected);
    free(in_place);
    free(points_f32);
    free(corrected_f32);
    free(flags);
    free(flags_f32);
    return 0;
}
