/* How to use it. Nothing here allocates, waits, or has state of its own; link with -lm. A state is one camera's.
 *
 *     drift_state state;
 *     drift_init(&state);
 *     drift_advance(&state, dt_s, ambient_degC, power_on, camera_degC);  every few seconds, from switching on
 *     drift_correct(&state, xy_px, reference_px, flags, count);          x to the right, y down, px
 *
 * Integer pixel coordinates are pixel centres. Temperatures that are NaN or none at all (below -273.15, above 1000 degC)
 * count as unknown; positions may be anything. Flags are 0 inside the calibrated range; a value is NaN where the thermal
 * state is unknown.
 */
#ifdef __FAST_MATH__
#error "-ffast-math takes NaN for a number, and would hide what is unknown"
#endif

enum {
    DRIFT_PLACE = 1,        /* outside the markers' hull */
    DRIFT_CAMERA = 2,       /* the camera's temperature is outside the calibrated range */
    DRIFT_AMBIENT = 4,      /* the air's temperature is outside the calibrated range */
    DRIFT_SWITCHED_ON = 8,  /* the camera was switched on too recently */
    DRIFT_HISTORY = 16,     /* the camera has not been followed for long enough */
    DRIFT_STATE = 32        /* each is in its range, but not in this combination */
};

typedef struct drift_state {
    int begun;  /* 0 in a gap */
    int unseen; /* 1 from a begin without power or temperature, until the camera reports one */
    double settled_s, on_s;
    double values[DRIFT_VALUES]; /* degC of the camera and of the air, the supply, then lags and plays */
    unsigned flags;                /* of the state, for every position */
    double field[2][DRIFT_FIELD];  /* the displacement as polynomials of the position, px */
    float field_f32[2][DRIFT_FIELD];
} drift_state;

static inline int drift_is_temperature(double degC) { return degC >= -273.15 && degC <= 1000.0; }

static inline double drift_clip(double value, double low, double high) {
    return value < low ? low : value > high ? high : value;
}

static inline unsigned drift_beyond(double value, double low, double high, unsigned flag) {
    return value >= low && value <= high ? 0u : flag;
}

/* A follower of an input with this mean over the time that has passed, exactly; and a play, which stays where it is until
 * what pushes it is further away than its radius. */
static inline void drift_lag(double *now, double *mean, int at, double input, double dt_s, double tau_s) {
    const double before = now[at];
    now[at] += (input - before) * -expm1(-dt_s / tau_s);
    mean[at] = (before + now[at]) / 2;
}

static inline void drift_play(double *now, double *mean, int at, double push, double radius_K) {
    now[at] = mean[at] = drift_clip(now[at], push - radius_K, push + radius_K);
}

/* Lags and plays in equilibrium, and moved on; the terms of the thermal state, less those of the reference. */
/* the terms */

static inline unsigned drift_state_flags(const drift_state *state, const double values[DRIFT_TERMS]) {
    unsigned found =
        drift_beyond(state->values[0], drift_camera_range_degC[0], drift_camera_range_degC[1], DRIFT_CAMERA);
#if DRIFT_THERMAL
    double leverage = 0.0;
    int k, l;
    if (!state->begun) return DRIFT_CAMERA | DRIFT_AMBIENT | DRIFT_SWITCHED_ON | DRIFT_HISTORY | DRIFT_STATE;
    found |= drift_beyond(state->values[DRIFT_AMBIENT_LAG], drift_ambient_range_degC[0], drift_ambient_range_degC[1],
                          DRIFT_AMBIENT);
    found |= drift_beyond(state->on_s, DRIFT_LEAST_ON_S, HUGE_VAL, DRIFT_SWITCHED_ON);
    found |= drift_beyond(state->settled_s, DRIFT_MEMORY_S, HUGE_VAL, DRIFT_HISTORY);
    for (k = 0; k < DRIFT_TERMS; ++k) {
        for (l = 0; l < DRIFT_TERMS; ++l) leverage += values[k] * drift_leverage_matrix[k][l] * values[l];
    }
    found |= drift_beyond(leverage, 0.0, DRIFT_MOST_LEVERAGE, DRIFT_STATE);
#else
    (void)values;
#endif
    return found;
}

/* Flags and displacement of the present state. */
static inline void drift_update(drift_state *state) {
    double values[DRIFT_TERMS];
    int axis, k, term;
    drift_terms(state->values, values);
    state->flags = drift_state_flags(state, values);
    for (axis = 0; axis < 2; ++axis) {
        for (k = 0; k < DRIFT_FIELD; ++k) {
            double amount = 0.0;
            for (term = 0; term < DRIFT_TERMS; ++term) amount += drift_coefficients[axis][k][term] * values[term];
            if (DRIFT_THERMAL && !state->begun) amount = NAN;
            state->field[axis][k] = amount;
            state->field_f32[axis][k] = fabs(amount) < 1e30 ? (float)amount : NAN;
        }
    }
}

/* Before the first sample. */
static inline void drift_init(drift_state *state) {
    int k;
    state->begun = state->unseen = 0;
    state->settled_s = state->on_s = NAN;
    for (k = 0; k < DRIFT_VALUES; ++k) state->values[k] = NAN;
    drift_update(state);
}

/* In equilibrium, with the part of its self-heating that the camera shows: a guess, unless it is as cold as the air
 * now, or, without power until then, when it is switched on. */
static inline void drift_begin(drift_state *state, double ambient_degC, double power_on, double camera_degC) {
    const int known = drift_is_temperature(camera_degC);
    const double excess_K = known ? camera_degC - ambient_degC : 0.0;
    const int cold = known && fabs(excess_K) < DRIFT_COLD_K;
    state->begun = 1;
    state->unseen = power_on == 0.0 && !known;
    state->settled_s = cold ? HUGE_VAL : 0.0;
    state->on_s = cold || power_on == 0.0 ? 0.0 : HUGE_VAL;
    state->values[0] = ambient_degC + excess_K;
    state->values[1] = ambient_degC;
    state->values[2] = cold ? 0.0 : drift_clip(excess_K / DRIFT_SELF_HEATING_K, 0.0, 1.0);
    drift_rest(state->values);
}

/* dt_s have passed, with this mean temperature of the air near the camera and this share (0..1) of them powered; at
 * their end the camera has this temperature (NaN: unknown). An unknown ambient, or a time or share that cannot be, is a
 * gap: what was remembered is lost. Returns the flags of the state. */
static inline unsigned drift_advance(drift_state *state, double dt_s, double ambient_degC, double power_on,
                                     double camera_degC) {
    double before_degC, excess_K, mean[DRIFT_VALUES];
    if (!(dt_s >= 0.0 && dt_s < HUGE_VAL && drift_is_temperature(ambient_degC) && power_on >= 0.0 && power_on <= 1.0)) {
        state->begun = 0;
        state->values[0] = drift_is_temperature(camera_degC) ? camera_degC : (double)NAN;
        drift_update(state);
        return state->flags;
    }
    if (!state->begun) drift_begin(state, ambient_degC, power_on, camera_degC);
    before_degC = state->values[0];
    excess_K = (before_degC - state->values[1]) * exp(-dt_s / DRIFT_UNPOWERED_TAU_S);
    state->values[0] = drift_is_temperature(camera_degC) ? camera_degC : ambient_degC + excess_K;
    state->values[1] = ambient_degC;
    state->values[2] = power_on;
    memcpy(mean, state->values, sizeof mean);
    mean[0] = (before_degC + state->values[0]) / 2;
    drift_follow(state->values, mean, dt_s);
    if (state->unseen && drift_is_temperature(camera_degC)) {
        state->unseen = 0;
        if (fabs(camera_degC - ambient_degC) < DRIFT_COLD_K) state->settled_s = HUGE_VAL;
    }
    state->settled_s += dt_s;
    state->on_s = power_on == 1.0 ? state->on_s + dt_s : dt_s * power_on;
    drift_update(state);
    return state->flags;
}

/* Displacement, px, of a position to where it would be at the reference. */
static inline void drift_shift(const drift_state *state, double x_px, double y_px, double shift_px[2]) {
    const double x = (x_px - DRIFT_MIDDLE_X) / DRIFT_SPAN_X, y = (y_px - DRIFT_MIDDLE_Y) / DRIFT_SPAN_Y;
    int axis, a, b, k;
    for (axis = 0; axis < 2; ++axis) {
        const double *field = state->field[axis];
        double total = 0.0;
        for (b = DRIFT_DEGREE, k = DRIFT_FIELD; b >= 0; --b) {
            double row = 0.0;
            for (a = DRIFT_DEGREE - b; a >= 0; --a) row = row * x + field[--k];
            total = total * y + row;
        }
        shift_px[axis] = total;
    }
}

/* As drift_shift, in single precision: a displacement to 1e-6 of its size. Add it to positions that are doubles, or lose
 * 1e-4 px of a position of 2000 px. */
static inline void drift_shift_f32(const drift_state *state, float x_px, float y_px, float shift_px[2]) {
    const float x = (x_px - (float)DRIFT_MIDDLE_X) / (float)DRIFT_SPAN_X;
    const float y = (y_px - (float)DRIFT_MIDDLE_Y) / (float)DRIFT_SPAN_Y;
    int axis, a, b, k;
    for (axis = 0; axis < 2; ++axis) {
        const float *field = state->field_f32[axis];
        float total = 0.0f;
        for (b = DRIFT_DEGREE, k = DRIFT_FIELD; b >= 0; --b) {
            float row = 0.0f;
            for (a = DRIFT_DEGREE - b; a >= 0; --a) row = row * x + field[--k];
            total = total * y + row;
        }
        shift_px[axis] = total;
    }
}

/* Why the correction of this position is an extrapolation, 0 when it is not. */
static inline unsigned drift_flags(const drift_state *state, double x_px, double y_px) {
    unsigned outside = 0u;
    int side;
    for (side = 0; side < DRIFT_SIDES; ++side) {
        const double *along = drift_hull[side];
        outside |= drift_beyond(along[0] * (y_px - along[3]) - along[1] * (x_px - along[2]), -DRIFT_HULL_MARGIN_PX,
                                HUGE_VAL, DRIFT_PLACE);
    }
    return outside | state->flags;
}

/* `count` positions x, y, x, y ... to where they would be at the reference, which may be the same place; `flags` (count)
 * may be NULL. Returns how many have a flag. */
static inline size_t drift_correct(const drift_state *state, const double *xy_px, double *reference_px,
                                   unsigned char *flags, size_t count) {
    size_t flagged = 0, n;
    for (n = 0; n < count; ++n) {
        const double x = xy_px[2 * n], y = xy_px[2 * n + 1];
        const unsigned found = drift_flags(state, x, y);
        double shift_px[2];
        drift_shift(state, x, y, shift_px);
        reference_px[2 * n] = x + shift_px[0];
        reference_px[2 * n + 1] = y + shift_px[1];
        if (flags) flags[n] = (unsigned char)found;
        flagged += found != 0u;
    }
    return flagged;
}

/* As drift_correct, of and to floats. */
static inline size_t drift_correct_f32(const drift_state *state, const float *xy_px, float *reference_px,
                                       unsigned char *flags, size_t count) {
    size_t flagged = 0, n;
    for (n = 0; n < count; ++n) {
        const float x = xy_px[2 * n], y = xy_px[2 * n + 1];
        const unsigned found = drift_flags(state, (double)x, (double)y);
        float shift_px[2];
        drift_shift_f32(state, x, y, shift_px);
        reference_px[2 * n] = x + shift_px[0];
        reference_px[2 * n + 1] = y + shift_px[1];
        if (flags) flags[n] = (unsigned char)found;
        flagged += found != 0u;
    }
    return flagged;
}

/* One row of the lattice of offsets, at every DRIFT_STEP_PX-th pixel, the last beyond the image: where a point that is
 * seen there at the reference is in the measured image, less its place. The shift maps measured to reference, and is
 * inverted by fixed-point steps; it changes by some 1e-4 px per px. Loops run along the row, so that a processor takes
 * several positions at once. */
static inline void drift_lattice_row(const drift_state *state, int y_px, float row[2][DRIFT_CELLS_X + 1]) {
    double x[DRIFT_CELLS_X + 1], y[DRIFT_CELLS_X + 1], part[DRIFT_CELLS_X + 1];
    double offset[2][DRIFT_CELLS_X + 1], next[2][DRIFT_CELLS_X + 1];
    int cell, round, axis, a, b, k;
    for (cell = 0; cell <= DRIFT_CELLS_X; ++cell) offset[0][cell] = offset[1][cell] = 0.0;
    for (round = 0; round < DRIFT_ROUNDS; ++round) {
        double change = 0.0;
        for (cell = 0; cell <= DRIFT_CELLS_X; ++cell) {
            x[cell] = (cell * DRIFT_STEP_PX + offset[0][cell] - DRIFT_MIDDLE_X) / DRIFT_SPAN_X;
            y[cell] = (y_px + offset[1][cell] - DRIFT_MIDDLE_Y) / DRIFT_SPAN_Y;
        }
        for (axis = 0; axis < 2; ++axis) {
            const double *field = state->field[axis];
            double *total = next[axis];
            for (cell = 0; cell <= DRIFT_CELLS_X; ++cell) total[cell] = 0.0;
            for (b = DRIFT_DEGREE, k = DRIFT_FIELD; b >= 0; --b) {
                for (cell = 0; cell <= DRIFT_CELLS_X; ++cell) part[cell] = 0.0;
                for (a = DRIFT_DEGREE - b; a >= 0; --a) {
                    const double coefficient = field[--k];
                    for (cell = 0; cell <= DRIFT_CELLS_X; ++cell) part[cell] = part[cell] * x[cell] + coefficient;
                }
                for (cell = 0; cell <= DRIFT_CELLS_X; ++cell) total[cell] = total[cell] * y[cell] + part[cell];
            }
        }
        for (axis = 0; axis < 2; ++axis) {
            for (cell = 0; cell <= DRIFT_CELLS_X; ++cell) {
                const double moved = fabs(offset[axis][cell] + next[axis][cell]);
                change = moved > change ? moved : change;
                offset[axis][cell] = -next[axis][cell];
            }
        }
        if (change < 1e-5) break;
    }
    for (axis = 0; axis < 2; ++axis) {
        for (cell = 0; cell <= DRIFT_CELLS_X; ++cell) row[axis][cell] = (float)offset[axis][cell];
    }
}

/* One of the maps between two rows of the lattice: image rows y .. end - 1 from `out` on. Eight cells side by side at a
 * time, so that their values stay in the processor while the rows are written. */
static inline void drift_map_band(const float *upper, const float *lower, int along_x, int y, int end, float *out) {
    enum { DRIFT_PART = 8 * DRIFT_STEP_PX };
    float base[DRIFT_PART], down[DRIFT_PART];
    int begin, row, x, k;
    for (begin = 0; begin < DRIFT_WIDTH; begin += DRIFT_PART) {
        const int count = DRIFT_WIDTH - begin < DRIFT_PART ? DRIFT_WIDTH - begin : DRIFT_PART;
        for (k = 0; k < count; ++k) {
            const int cell = (begin + k) / DRIFT_STEP_PX;
            const float u = (float)(k % DRIFT_STEP_PX) / DRIFT_STEP_PX;
            const float above = upper[cell] + u * (upper[cell + 1] - upper[cell]);
            base[k] = above + (along_x ? (float)(begin + k) : 0.0f);
            down[k] = lower[cell] + u * (lower[cell + 1] - lower[cell]) - above;
        }
        for (row = y; row < end; ++row) {
            const float v = (float)(row % DRIFT_STEP_PX) / DRIFT_STEP_PX, origin = along_x ? 0.0f : (float)row;
            float *to = out + (size_t)(row - y) * DRIFT_WIDTH + begin;
            for (x = 0; x < count; ++x) to[x] = origin + (base[x] + v * down[x]);
        }
    }
}

/* Maps for cv::remap and its like: at pixel (x, y) of the corrected image stands where to read in the measured one.
 * Rows first_row .. first_row + rows - 1 of DRIFT_WIDTH floats each; a strip of some rows stays in the processor's cache.
 * The offset is evaluated every DRIFT_STEP_PX px and bilinear in between. Returns the flags of the state, or -1, and
 * writes nothing, for rows that are not in the image or an unknown state. */
static inline int drift_map(const drift_state *state, int first_row, int rows, float *map_x, float *map_y) {
    float lattice[2][2][DRIFT_CELLS_X + 1];
    int y, end, axis, k;
    if (first_row < 0 || rows < 0 || rows > DRIFT_HEIGHT - first_row) return -1;
    for (axis = 0; axis < 2; ++axis) {
        for (k = 0; k < DRIFT_FIELD; ++k) {
            if (!(fabs(state->field[axis][k]) < 1e6)) return -1;
        }
    }
    drift_lattice_row(state, first_row / DRIFT_STEP_PX * DRIFT_STEP_PX, lattice[1]);
    for (y = first_row; y < first_row + rows; y = end) {
        end = (y / DRIFT_STEP_PX + 1) * DRIFT_STEP_PX;
        memcpy(lattice[0], lattice[1], sizeof lattice[0]);
        drift_lattice_row(state, end, lattice[1]);
        if (end > first_row + rows) end = first_row + rows;
        for (axis = 0; axis < 2; ++axis) {
            float *out = (axis == 0 ? map_x : map_y) + (size_t)(y - first_row) * DRIFT_WIDTH;
            drift_map_band(lattice[0][axis], lattice[1][axis], axis == 0, y, end, out);
        }
    }
    return (int)state->flags;
}
