/* Segments seen as a whole: see composite/xray.py and composite/maximum_intensity.py. */
#ifndef JAXVR_WHOLE_H
#define JAXVR_WHOLE_H

#include "lanes.h"

/* What pixels are made of: light over light; optical depths alone, with the length of the ray in the
 * volume; the scalar's integral, with that length; the largest scalar. */
typedef enum { OVER, DEPTHS, INTEGRAL, MAXIMUM } Compositor;

/* Before a lane's first segment. SLAB counts segments where there are no slabs. */
static void begin_whole(Lanes *lanes, int n) {
  for (int i = 0; i < n; i++) lanes->integer[WHERE][i] = -1, lanes->integer[SLAB][i] = 0;
}

static inline word_t in_sight(const Lanes *lanes, int i) {
  return MASK(lanes->row[LENGTH][i] > 0) & ~MASK(lanes->integer[LOST][i] != 0);
}

/* Adds x to the sum in row k of a lane. */
static inline void add_row(Lanes *lanes, int k, int i, real x) {
  real sum = lanes->row[SUMS + k][i], excess = lanes->row[SUMS + 4 + k][i];
  add_to(&sum, &excess, x);
  lanes->row[SUMS + k][i] = sum;
  lanes->row[SUMS + 4 + k][i] = excess;
}

static void add_lengths(Lanes *lanes, int n) {
  LANES_LOOP
  for (int i = 0; i < n; i++)
    add_row(lanes, 1, i, PICK(in_sight(lanes, i), lanes->row[LENGTH][i], 0));
}

static inline real mean(const Lanes *lanes, int i) {
  return (real)0.5 * lanes->row[FRONT][i] + (real)0.5 * lanes->row[BACK][i];
}

static void add_integrals(Lanes *lanes, int n) {
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    real integral = lanes->row[LENGTH][i] * mean(lanes, i);
    add_row(lanes, 0, i, PICK(in_sight(lanes, i), integral, 0));
  }
  add_lengths(lanes, n);
}

/* Whether a > b, with NaN above all numbers. */
static inline int exceeds(real a, real b) { return (a > b) | ((a != a) & (b == b)); }

static void add_largest(Lanes *lanes, int n) {
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    real front = lanes->row[FRONT][i], back = lanes->row[BACK][i];
    int at_back = exceeds(back, front), before = lanes->integer[WHERE][i];
    real most = at_back ? back : front;
    int larger = (before < 0) | exceeds(most, lanes->row[SUMS][i]);
    larger &= (int)in_sight(lanes, i) & 1;
    lanes->row[SUMS][i] = larger ? most : lanes->row[SUMS][i];
    lanes->integer[WHERE][i] = larger ? 2 * lanes->integer[SLAB][i] + at_back : before;
    lanes->integer[SLAB][i] += lanes->integer[LOST][i] == 0;
  }
}

/* Cotangents of the segments, from PIXEL: those of the integral and of the length. Segments of no
 * length have them too, or derivatives would not telescope. */
static void pull_integrals(Lanes *lanes, int n) {
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    word_t seen = ~MASK(lanes->integer[LOST][i] != 0);
    real bar = lanes->row[PIXEL][i], half = (real)0.5 * lanes->row[LENGTH][i] * bar;
    lanes->row[SBAR][i] = lanes->row[SBAR + 1][i] = PICK(seen, half, 0);
    lanes->row[SBAR + 2][i] = PICK(seen, bar * mean(lanes, i) + lanes->row[PIXEL + 1][i], 0);
  }
}

/* The same of the largest scalar, which is where WHERE says. */
static void pull_largest(Lanes *lanes, int n) {
  LANES_LOOP
  for (int i = 0; i < n; i++) {
    int where = lanes->integer[WHERE][i], here = where >> 1 == lanes->integer[SLAB][i];
    here &= lanes->integer[LOST][i] == 0;
    real bar = lanes->row[PIXEL][i];
    lanes->row[SBAR][i] = here & !(where & 1) ? bar : 0;
    lanes->row[SBAR + 1][i] = here & where & 1 ? bar : 0;
    lanes->row[SBAR + 2][i] = 0;
    lanes->integer[SLAB][i] += lanes->integer[LOST][i] == 0;
  }
}

#endif
