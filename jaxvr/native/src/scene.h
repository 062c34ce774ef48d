/* The mesh, and where a ray crosses its faces: see trace/scene.py, shear.py, face.py, local.py. */
#ifndef JAXVR_SCENE_H
#define JAXVR_SCENE_H

#include "lanes.h"
#include "watch.h"

enum { AT_POINTS, AT_CELLS, AT_CORNERS };

/* vertices (P, 4): coordinates and, for values at points, the scalar. points, count: P and T. */
typedef struct {
  const real *vertices, *values;
  const int32_t *cells, *neighbors;
  int location, seams;
  int64_t points, count;
  Watch *watch;
} Mesh;

/* One ray, as the walk sees it: trace/shear.py. S_x = high + rest, low_head: head of its lost part. */
typedef struct {
  int axis[3];
  real origin[3], x_high, x_rest, x_low, y_high, y_rest, y_low, sign;
} Ray;

INLINE int entry_corner(int corner, int k) { return k + (corner <= k); }

INLINE real value_at(const Mesh *mesh, int cell, int corner, int point) {
  if (mesh->location == AT_POINTS) return mesh->vertices[4 * (int64_t)point + 3];
  return mesh->values[mesh->location == AT_CELLS ? cell : 4 * (int64_t)cell + corner];
}

/* (a + a_low) - (s + s_low) (z + z_low), by exact products of halves. */
INLINE real accurate(real a, real a_low, real z_high, real z_rest, real z_low_head, real s_high,
                     real s_rest, real s_low_head) {
  real first, lost;
  two_sum(a, -(s_high * z_high), &first, &lost);
  real low = ((lost - s_high * z_rest) - s_rest * z_high) - s_rest * z_rest;
  return first + (((low + a_low) - s_high * z_low_head) - s_low_head * z_high);
}

INLINE void shear(real px, real py, real pz, real ox, real oy, real oz, real x_high, real x_rest,
                  real x_low, real y_high, real y_rest, real y_low, real sign, real *x, real *y,
                  real *z, real *z_low) {
  real ax, axl, ay, ayl, az, azl;
  two_sum(px, -ox, &ax, &axl);
  two_sum(py, -oy, &ay, &ayl);
  two_sum(pz, -oz, &az, &azl);
  real high = head(az), rest = az - high, low_head = head(azl);
  *x = accurate(ax, axl, high, rest, low_head, x_high, x_rest, x_low);
  *y = accurate(ay, ayl, high, rest, low_head, y_high, y_rest, y_low);
  *z = sign * az;
  *z_low = sign * azl;
}

/* |2 area| of (origin, i, j) and the mask of its sign, exactly: numerics/exact.py, edge_side.
 * i_first is a mask too. */
INLINE real edge(real xi, real yi, real xj, real yj, word_t i_first, word_t *positive) {
  real p = xi * yj, q = xj * yi;
  real p_low = product_low(xi, yj, p), q_low = product_low(xj, yi, q);
  word_t same_high = MASK(p == q), same_y = MASK(yi == yj), same = same_y & MASK(xi == xj);
  word_t greater = MASK(p > q) | (same_high & MASK(p_low > q_low));
  word_t equal = same_high & MASK(p_low == q_low);
  word_t shifted = MASK(yi > yj) | (same_y & MASK(xj > xi));
  shifted = (same & ~(MASK(xi > 0) ^ i_first)) | (~same & shifted);
  *positive = (equal & shifted) | (~equal & greater);
  return ABS((p - q) + (p_low - q_low));
}

/* For a ray in the face's plane: weights of the point where an edge meets it. */
static inline void weights_on_edge(const real x[3], const real y[3], real w[3]) {
  static const int ends[3][2] = {{0, 1}, {1, 2}, {0, 2}};
  real size[3];
  for (int k = 0; k < 3; k++) size[k] = ABS(x[k]) + ABS(y[k]);
  for (int k = 0; k < 3; k++) {
    int i = ends[k][0], j = ends[k][1];
    if (x[i] * x[j] + y[i] * y[j] <= 0) {
      w[i] = size[i] + size[j] == 0 ? 1 : size[j];
      w[j] = size[i];
      w[3 - i - j] = 0;
      return;
    }
  }
  w[0] = 1, w[1] = w[2] = 0;
}

/* The crossing of a face (three vertices) from barycentric coordinates of its last two vertices. */
INLINE void crossing(real az, real al, real av, real bz, real bl, real bv, real cz, real cl,
                     real cv, real of_b, real of_c, real *z, real *z_low, real *value) {
  real step = of_b * ((bz - az) + (bl - al));
  step = step + of_c * ((cz - az) + (cl - al));
  real sum, lost;
  two_sum(az, step, &sum, &lost);
  two_sum(sum, lost + al, z, z_low);
  *value = av + (of_b * (bv - av) + of_c * (cv - av));
}

/* The id of a cell's corner. */
static inline int32_t point_at(const Mesh *mesh, int cell, int corner) {
  return within(mesh->watch, mesh->cells[4 * (int64_t)cell + corner], mesh->points);
}

/* A vertex of a face as a single ray sees it: five numbers. */
static inline void see(const Mesh *mesh, const Ray *ray, int cell, int corner, real out[VERTEX]) {
  int point = point_at(mesh, cell, corner);
  const real *p = mesh->vertices + 4 * (int64_t)point;
  shear(p[ray->axis[0]], p[ray->axis[1]], p[ray->axis[2]], ray->origin[0], ray->origin[1],
        ray->origin[2], ray->x_high, ray->x_rest, ray->x_low, ray->y_high, ray->y_rest, ray->y_low,
        ray->sign, out + VX, out + VY, out + VZ, out + VLOW);
  out[VVALUE] = value_at(mesh, cell, corner, point);
}

/* Barycentric coordinates of b and c from weights, which are replaced where they are all zero. */
static inline void shares(const real x[3], const real y[3], real w[3], real *of_b, real *of_c) {
  if (w[0] + w[1] + w[2] == 0) {
    real on[3];
    weights_on_edge(x, y, on);
    real sum = on[0] + on[1] + on[2];
    *of_b = on[1] / sum, *of_c = on[2] / sum;
    return;
  }
  real sum = (w[0] + w[1]) + w[2];
  *of_b = w[1] / sum, *of_c = w[2] / sum;
}

/* What a single ray sees of a face opposite a corner: vertices, weights, signs of the edges, and
 * the crossing. Returns whether all three signs agree. */
typedef struct {
  real vertex[3][VERTEX], weight[3], z, z_low, value;
  int positive;
} FaceSeen;

static inline int see_face(const Mesh *mesh, const Ray *ray, int cell, int corner, FaceSeen *out) {
  word_t sign[3];
  for (int k = 0; k < 3; k++) see(mesh, ray, cell, entry_corner(corner, k), out->vertex[k]);
  real(*v)[VERTEX] = out->vertex;
  out->weight[0] = edge(v[1][VX], v[1][VY], v[2][VX], v[2][VY], -1, &sign[0]);
  out->weight[1] = edge(v[2][VX], v[2][VY], v[0][VX], v[0][VY], 0, &sign[1]);
  out->weight[2] = edge(v[0][VX], v[0][VY], v[1][VX], v[1][VY], -1, &sign[2]);
  real x[3] = {v[0][VX], v[1][VX], v[2][VX]}, y[3] = {v[0][VY], v[1][VY], v[2][VY]}, of_b, of_c;
  shares(x, y, out->weight, &of_b, &of_c);
  crossing(v[0][VZ], v[0][VLOW], v[0][VVALUE], v[1][VZ], v[1][VLOW], v[1][VVALUE], v[2][VZ],
           v[2][VLOW], v[2][VVALUE], of_b, of_c, &out->z, &out->z_low, &out->value);
  out->positive = sign[2] != 0;
  return sign[0] == sign[1] && sign[1] == sign[2];
}

#endif
