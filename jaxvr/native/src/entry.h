/* Where rays enter: see trace/entry.py. A packet of neighbouring rays goes down the hierarchy
 * together, to wherever one of them has to; the exact test is made for rays that meet the leaf. */
#ifndef JAXVR_ENTRY_H
#define JAXVR_ENTRY_H

#include "scene.h"

#define PACKET 64

/* Boxes of heap nodes (3, 2 leaves), and the boundary face of each leaf, or -1. */
typedef struct {
  const real *low, *high;
  const int32_t *faces;
  int64_t leaves;
} Tree;

/* The next entries of a ray by (depth, face), and whether there are others behind them. */
typedef struct {
  real depth[ENTRIES];
  int32_t face[ENTRIES];
  int count, next, more;
} Entries;

static inline int comes_before(real depth, int32_t face, real than_depth, int32_t than_face) {
  return depth < than_depth || (depth == than_depth && face < than_face);
}

static inline void insert(Entries *list, real depth, int32_t face) {
  int k = list->count;
  if (k == ENTRIES) {
    list->more = 1;
    if (!comes_before(depth, face, list->depth[k - 1], list->face[k - 1])) return;
    k--;
  } else list->count++;
  for (; k > 0 && comes_before(depth, face, list->depth[k - 1], list->face[k - 1]); k--) {
    list->depth[k] = list->depth[k - 1];
    list->face[k] = list->face[k - 1];
  }
  list->depth[k] = depth;
  list->face[k] = face;
}

/* The entries of `count` rays with the same axes, behind (last_depth, last_face) of each. */
static void search_packet(const Mesh *mesh, const Tree *tree, int count, const Ray *const *rays,
                          Entries *const *lists, const real *last_depth,
                          const int32_t *last_face) {
  _Alignas(64) real ox[PACKET], oy[PACKET], oz[PACKET], sx[PACKET], sy[PACKET], slack[PACKET];
  _Alignas(64) int32_t meets[PACKET];
  int64_t nodes = 2 * tree->leaves;
  const int *axis = rays[0]->axis;
  const real *low[3], *high[3];
  real reach = 1;
  for (int k = 0; k < 3; k++) {
    low[k] = tree->low + axis[k] * nodes;
    high[k] = tree->high + axis[k] * nodes;
    reach = most(reach, ABS(tree->low[k * nodes + 1]));
  }
  for (int i = 0; i < count; i++) {
    const Ray *ray = rays[i];
    ox[i] = ray->origin[0], oy[i] = ray->origin[1], oz[i] = ray->origin[2];
    sx[i] = ray->x_high + ray->x_rest, sy[i] = ray->y_high + ray->y_rest;
    slack[i] = 16 * (real)REAL_EPS * (most(most(ABS(ox[i]), ABS(oy[i])), ABS(oz[i])) + reach);
  }
  for (int64_t node = 1; node > 0;) {
    real x0 = low[0][node], x1 = high[0][node], y0 = low[1][node], y1 = high[1][node];
    real z0 = low[2][node], z1 = high[2][node];
    int any = 0;
    LANES_LOOP
    for (int i = 0; i < count; i++) {
      real near = z0 - oz[i], far = z1 - oz[i];
      real a = sx[i] * near, b = sx[i] * far, c = sy[i] * near, d = sy[i] * far;
      int hit = ((x0 - ox[i]) - most(a, b) <= slack[i]) & ((x1 - ox[i]) - least(a, b) >= -slack[i]);
      hit &= ((y0 - oy[i]) - most(c, d) <= slack[i]) & ((y1 - oy[i]) - least(c, d) >= -slack[i]);
      meets[i] = hit;
      any |= hit;
    }
    if (any && node < tree->leaves) {
      node *= 2;
      continue;
    }
    int32_t word = any ? tree->faces[node - tree->leaves] : -1;
    if (word >> 4 >= mesh->count) is_broken(mesh->watch);
    else if (word >= 0) {
      int cell = word >> 4, corner = word & 3, inwards = (word >> 3) & 1;
      for (int i = 0; i < count; i++) {
        if (!meets[i]) continue;
        FaceSeen face;
        if (!see_face(mesh, rays[i], cell, corner, &face) || face.positive != inwards) continue;
        if (comes_before(last_depth[i], last_face[i], face.z, word)) insert(lists[i], face.z, word);
      }
    }
    int64_t after = node + 1;
    node = after >> __builtin_ctzll((unsigned long long)after);
    if (node == 1) node = 0;
  }
}

/* The entries of `count` rays (at most PACKET), whatever their axes are. */
static void search(const Mesh *mesh, const Tree *tree, int count, const Ray *rays, Entries *lists,
                   const real *last_depth, const int32_t *last_face) {
  char done[PACKET] = {0};
  for (int first = 0; first < count; first++) {
    if (done[first]) continue;
    const Ray *same[PACKET];
    Entries *of[PACKET];
    real depth[PACKET];
    int32_t face[PACKET];
    int m = 0;
    for (int i = first; i < count; i++) {
      if (done[i] || memcmp(rays[i].axis, rays[first].axis, sizeof rays[i].axis)) continue;
      lists[i].count = lists[i].next = lists[i].more = 0;
      same[m] = rays + i, of[m] = lists + i, depth[m] = last_depth[i], face[m] = last_face[i];
      done[i] = 1;
      m++;
    }
    search_packet(mesh, tree, m, same, of, depth, face);
  }
}

#endif
