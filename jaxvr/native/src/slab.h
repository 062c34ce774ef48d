/* The integral of one slab, and the pieces of a segment in the slabs of a transfer function: see
 * numerics/moments.py and optics/partition.py. */
#ifndef JAXVR_SLAB_H
#define JAXVR_SLAB_H

#include "real.h"

#define MOST_NODES 32
#define JUMP_WIDTH ((real)1e-20)

/* by_front, by_back, and weights times the Bernstein basis of degree 2, at n nodes. `small`: the
 * rule errs by more than rounding, so that alpha comes from the depth. */
typedef struct {
  int count, small;
  real depth, by_front[MOST_NODES], by_back[MOST_NODES], factor[3][MOST_NODES];
} Rule;

/* Slab k of K + 1, between control points k - 1 and k (the outermost have one twice). dark_from to
 * dark_to: its scalars if it is transparent, else none. */
typedef struct {
  real floor, ceiling, low, slope;      /* slope: 1 / width, 0 outside the control points */
  real left[4], change[4];              /* extinction, r, g, b at the lower end; upper - lower */
  real width, jump, dark_from, dark_to;
} Slab;

typedef struct {
  int count; /* control points */
  const real *position;
  const Slab *slabs;
} Transfer;

/* Number of control points at or below s. */
static inline int locate(const Transfer *tf, real s) {
  int low = 0, high = tf->count;
  while (low < high) {
    int middle = (low + high) / 2;
    if (tf->position[middle] <= s) low = middle + 1;
    else high = middle;
  }
  return low;
}

/* Moments B0, B1, B2 of the transmittance along a slab with end depths a and b, >= 0. */
INLINE void moments(const Rule *rule, const int count, real a, real b, real *b0, real *b1,
                    real *b2) {
  real depth2 = 2 * rule->depth;
  real inside = a * a + depth2 * (b - a);
  real visible = depth2 / (a + SQRT(most(inside, 0)));
  visible = visible < 1 ? visible : 1;
  real hidden = 1 - visible, front = a * visible, back = visible * (a * hidden + b * visible);
  real l0 = 0, l1 = 0, l2 = 0;
#pragma GCC unroll 32
  for (int k = 0; k < count; k++) {
    real t = exp_negative(-muladd(front, rule->by_front[k], back * rule->by_back[k]));
    l0 = muladd(rule->factor[0][k], t, l0);
    l1 = muladd(rule->factor[1][k], t, l1);
    l2 = muladd(rule->factor[2][k], t, l2);
  }
  *b0 = visible * (l0 + hidden * l1 + hidden * hidden * l2);
  *b1 = visible * visible * (l1 + 2 * hidden * l2);
  *b2 = visible * visible * visible * l2;
}

INLINE real transmittance(real a, real b) {
  real total = a + b, part = total - a, lost = (a - (total - part)) + (b - part);
  return exp_negative((real)-0.5 * total) * (1 - (real)0.5 * lost);
}

/* 1 - exp(-x) for x >= 0: by its own series where exp(-x) would round it away. */
INLINE real opacity(real x) {
  static const real inverse[] = {1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720,
                                 1.0 / 5040, 1.0 / 40320, 1.0 / 362880, 1.0 / 3628800,
                                 1.0 / 39916800, 1.0 / 479001600, 1.0 / 6227020800.0};
  real sum = inverse[EXP_TERMS - 1];
#pragma GCC unroll 16
  for (int k = EXP_TERMS - 2; k >= 0; k--) sum = muladd(sum, -x, inverse[k]);
  return x < (real)0.34 ? x * sum : 1 - exp_negative(-x);
}

#endif
