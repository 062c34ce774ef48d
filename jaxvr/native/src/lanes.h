/* A block of rays side by side: each quantity is a row with one number a ray (a lane), so that a
 * loop over lanes becomes vector instructions. Lanes 0 to n - 1 are in use; when a ray is through,
 * the last one takes its place, so that no vector carries finished rays. */
#ifndef JAXVR_LANES_H
#define JAXVR_LANES_H

#include "real.h"

#define LANES 128       /* rays in a block; its rows stay in the cache */
#define ENTRIES 8       /* entries of a ray found at a time */
#define SLAB_NUMBERS 16 /* see slab.h */
#define RAY_BARS 8      /* cotangents of a ray; of one without bounds the last two are 0 */
#define NODE_PAIR 10    /* position, extinction, r, g, b of a slab's lower and upper control point */

enum { VX, VY, VZ, VLOW, VVALUE, VERTEX }; /* rows of a vertex, see trace/shear.py */

/* Rows of numbers. FACE: three vertices of the entry face; WEIGHT: their barycentric weights;
 * APEX: the fourth vertex; LEAVE: weights of the exit face's vertices, OF_B and OF_C: barycentric
 * coordinates of the last two. DEPTH: how far the ray has come; LEAD: by how much farther that is
 * than the face it stands in, 0 but behind overturned cells, and CUT: what that was at the segment's
 * entry, see make_segment of trace/local.py; VALUE: the scalar at the face ahead, which BACK is not
 * where a segment is cut. RECORD: the numbers of the slab that SLAB names. SUMS:
 * compensated optical depth and r, g, b, totals first. For derivatives, FINAL and PIXEL: those sums
 * at the ray's end and the pixel's cotangent; SBAR, RBAR, TBAR: cotangents of the segment's front,
 * back and length, of the ray's origin, S_x, S_y, stretch, near and far, and of the slab's control
 * points. NEAR, FAR, STOP: depths, see Rays of walk.h. */
enum {
  ORIGIN, SHEAR_X = ORIGIN + 3, SHEAR_Y = SHEAR_X + 3, SIGN = SHEAR_Y + 3, STRETCH, NEAR, FAR, STOP,
  FACE, WEIGHT = FACE + 3 * VERTEX, APEX = WEIGHT + 3, LEAVE = APEX + VERTEX,
  OF_B = LEAVE + 3, OF_C, DEPTH, LEAD = DEPTH + 2, CUT, VALUE, FRONT, BACK, LENGTH, CURSOR, RECORD,
  SUMS = RECORD + SLAB_NUMBERS, ROWS = SUMS + 8,
  FINAL = ROWS, PIXEL = FINAL + 8, SBAR = PIXEL + 4, RBAR = SBAR + 3,
  TBAR = RBAR + RAY_BARS,
  ALL_ROWS = TBAR + NODE_PAIR
};
enum { A = FACE, B = FACE + VERTEX, C = FACE + 2 * VERTEX };
/* Rows of integers. REACHED, CUT_AT: where LEAD or CUT is not 0, the word of the face where the
 * depth was reached. SIDES: where the segment's ends lie, bits 0 and 1 before NEAR, and bits 2 and 3
 * beyond FAR, see make_segment of trace/local.py. FRESH: the segment does not start where the one before
 * has ended, in scalar. WHERE: of the largest scalar, see whole.h. */
enum {
  RAY, AXES, WORD = AXES + 3, POINT, POSITIVE, DROP, REACHED, CUT_AT, SIDES, SLAB, FRESH, NEXT, END, LOST,
  SLOT, WHERE, INTEGERS
};

/* leads: whether any LEAD may not be 0; cuts: whether CUT has been written for these segments. */
typedef struct {
  _Alignas(64) real row[ALL_ROWS][LANES];
  _Alignas(64) int32_t integer[INTEGERS][LANES];
  int leads, cuts;
} Lanes;

static inline void move_lane(Lanes *lanes, int rows, int from, int to) {
  if (from == to) return;
  for (int k = 0; k < rows; k++) lanes->row[k][to] = lanes->row[k][from];
  for (int k = 0; k < INTEGERS; k++) lanes->integer[k][to] = lanes->integer[k][from];
}

#endif
