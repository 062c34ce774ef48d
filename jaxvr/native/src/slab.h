/* The integral of one slab, and the pieces of a segment in the slabs of a transfer function: see
 * numerics/moments.py and optics/partition.py. */
#ifndef JAXVR_SLAB_H
#define JAXVR_SLAB_H

#include "lanes.h"

/* by_front, by_back, and weights times the Bernstein basis of degree 2, at each node. Rules with
 * fewer than FULL_NODES or SMALL_NODES are filled up with zeros: loops want a constant. */
typedef struct {
  real by_front[FULL_NODES], by_back[FULL_NODES], factor[3][FULL_NODES];
} Sum;

/* `full` sees slabs to optical depth `depth`. `thin` has fewer nodes and is as exact where neither
 * a nor b is above `limit`, as in most cells. `small`: `full` has at most
 * SMALL_NODES and errs by more than rounding, so that alpha comes from the depth. */
typedef struct {
  Sum full, thin;
  int small;
  real depth, limit;
} Rule;

/* Numbers of slab k of K + 1, between control points k - 1 and k (the outermost have one twice):
 * its borders, the lower control point, 1 / width (0 outside the control points), extinction, r, g,
 * b there and their change to the upper one, whether its borders are positions of a jump (it is
 * one itself if they are equal), and its scalars if it is transparent (none if not). */
enum {
  FLOOR, CEILING, LOW, SLOPE, LEFT, CHANGE = LEFT + 4, HARD_FLOOR = CHANGE + 4, HARD_CEILING,
  DARK_FROM, DARK_TO
};

typedef struct {
  int count; /* control points */
  const real *position;
  const real *slabs; /* (K + 1, SLAB_NUMBERS) */
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

/* Sums over the nodes of a rule, for the depths a and b of what the rule sees. Written out, since
 * a loop over lanes with a loop in it is not turned into vectors; `count` is a constant. */
#define NODE(k)                                                                      \
  if (k < count) {                                                                   \
    real t = exp_negative(-muladd(a, sum->by_front[k], b * sum->by_back[k]));        \
    s0 = muladd(sum->factor[0][k], t, s0);                                           \
    s1 = muladd(sum->factor[1][k], t, s1);                                           \
    s2 = muladd(sum->factor[2][k], t, s2);                                           \
  }
INLINE void sum_nodes(const Sum *sum, const int count, real a, real b, real *l0, real *l1,
                      real *l2) {
  real s0 = 0, s1 = 0, s2 = 0;
  NODE(0) NODE(1) NODE(2) NODE(3) NODE(4) NODE(5) NODE(6) NODE(7) NODE(8) NODE(9) NODE(10) NODE(11)
  NODE(12)
#if FULL_NODES > 13
  NODE(13) NODE(14) NODE(15) NODE(16) NODE(17) NODE(18) NODE(19) NODE(20) NODE(21) NODE(22)
#endif
  *l0 = s0, *l1 = s1, *l2 = s2;
}

/* Moments B0, B1, B2 of the transmittance along a slab with end depths a and b, >= 0. */
INLINE void moments(const Rule *rule, const int count, real a, real b, real *b0, real *b1,
                    real *b2) {
  real depth2 = 2 * rule->depth, l0, l1, l2;
  real inside = a * a + depth2 * (b - a);
  real visible = depth2 / most(a + SQRT(most(inside, 0)), depth2); /* at most 1 */
  real hidden = 1 - visible;
  sum_nodes(&rule->full, count, a * visible, visible * (a * hidden + b * visible), &l0, &l1,
            &l2);
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
