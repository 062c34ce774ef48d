/* The loops that XLA calls. Arrays are described in native/kernels.py, which passes them. */
#include "parallel.h"
#include "play.h"
#include "pull.h"
#include "walk.h"
#include "whole.h"

typedef struct {
  Transfer transfer;
  Rule rule;
  real enough;
  Compositor compositor;
} Optics;

/* Gradients of one group of blocks, until they are added to those of all. */
typedef struct {
  enum { FREE, TAKEN, DONE } state;
  int group;
  double *table;
  Part vertices, values;
} Share;

/* Groups of blocks, which are added one after the other: sums are the same whatever the number of
 * threads is, if the number of groups is. `shares` are as many as threads want. */
typedef struct {
  pthread_mutex_t lock;
  int groups, next, turn, adding, count;
  Share *shares;
} Turns;

/* Everything that a block of rays needs; a kernel fills what it uses. */
typedef struct {
  World world;
  Nodes nodes;
  Optics optics;
  int64_t count; /* rays */
  Watch watch;
  /* results of a picture, (8, N), (N,), and (2, N) or NULL: WHERE and the number of segments */
  real *sums;
  int32_t *status, *where;
  /* of the number of nodes, and the nodes themselves from `start` (N,) on */
  int32_t *number;
  const int32_t *start;
  real *scalar, *length;
  int64_t total; /* of them */
  /* operands of derivatives: sums, cotangents (4, N) of those of light and depth in this order, or of
   * the first two, WHERE (N,) or NULL; and gradients, or NULL */
  const real *finals, *pixel_bar;
  const int32_t *goal;
  real *vertices_bar, *values_bar, *rays_bar;
  double *table_bar;
  int64_t table_size, vertices_size, values_size;
  Turns turns;
} Task;

/* vertices, values, cells, neighbors, low, high, faces, axes, numbers, bounds, options: arguments 0 to
 * 10. */
static World world_of(XLA_FFI_CallFrame *frame) {
  const int32_t *options = argument(frame, 10);
  World world = {
      {argument(frame, 0), argument(frame, 1), argument(frame, 2), argument(frame, 3), options[0],
       options[1], extent(frame, 0, 0) / 4, extent(frame, 2, 0) / 4, NULL},
      {argument(frame, 4), argument(frame, 5), argument(frame, 6), extent(frame, 6, 0)},
      {extent(frame, 7, 1), argument(frame, 7), argument(frame, 8),
       extent(frame, 9, 1) ? argument(frame, 9) : NULL},
  };
  return world;
}

/* A rule's rows (5, n), argument k. */
static void load_sum(XLA_FFI_CallFrame *frame, int k, Sum *sum) {
  const real *table = argument(frame, k);
  int64_t n = extent(frame, k, 1);
  memset(sum, 0, sizeof *sum);
  real *rows[] = {sum->by_front, sum->by_back, sum->factor[0], sum->factor[1], sum->factor[2]};
  for (int r = 0; r < 5; r++) memcpy(rows[r], table + r * n, n * sizeof(real));
}

/* positions, slabs, full rule, thin rule, numbers: arguments from `first` on. */
static Optics optics_of(XLA_FFI_CallFrame *frame, int first) {
  Optics optics;
  optics.transfer.count = (int)extent(frame, first, 0);
  optics.transfer.position = argument(frame, first);
  optics.transfer.slabs = argument(frame, first + 1);
  load_sum(frame, first + 2, &optics.rule.full);
  load_sum(frame, first + 3, &optics.rule.thin);
  const real *numbers = argument(frame, first + 4);
  optics.rule.depth = numbers[0];
  optics.rule.small = numbers[1] != 0;
  optics.rule.limit = numbers[2];
  optics.enough = numbers[3];
  optics.compositor = (Compositor)numbers[4];
  return optics;
}

static Nodes nodes_of(XLA_FFI_CallFrame *frame) {
  Nodes nodes = {argument(frame, 0), argument(frame, 1), argument(frame, 2), argument(frame, 3),
                 extent(frame, 0, 0), NULL};
  return nodes;
}

static int blocks_of(int64_t rays) { return (int)((rays + LANES - 1) / LANES); }

static int rays_in(const Task *task, int64_t first) {
  return task->count - first < LANES ? (int)(task->count - first) : LANES;
}

static void *aligned(size_t size) { return aligned_alloc(64, (size + 63) / 64 * 64); }

/* A block's memory; NULL if there is none, or nothing left to do. */
static Block *new_block(Task *task) {
  if (is_over(&task->watch)) return NULL;
  Block *block = aligned(sizeof(Block));
  if (!block) atomic_store(&task->watch.failed, 1);
  return block;
}

/* ---- pictures ---- */

/* The segments of the lanes go into their pixels. */
static void composite_segments(const Optics *optics, Lanes *lanes, int n) {
  switch (optics->compositor) {
  case INTEGRAL: add_integrals(lanes, n); return;
  case MAXIMUM: add_largest(lanes, n); return;
  case DEPTHS: add_lengths(lanes, n); /* and */
  case OVER: shade(&optics->transfer, &optics->rule, lanes, n);
  }
}

/* The same with derivatives: SBAR, TBAR and `table`. */
static void pull_segments(const Optics *optics, Lanes *lanes, int n, double *table) {
  switch (optics->compositor) {
  case INTEGRAL: pull_integrals(lanes, n); return;
  case MAXIMUM: pull_largest(lanes, n); return;
  default: pull_shading(&optics->transfer, &optics->rule, lanes, n, table);
  }
}

static void keep_sums(void *data, Lanes *lanes, int lane) {
  Task *task = data;
  int64_t n = task->count, r = lanes->integer[RAY][lane];
  for (int k = 0; k < 8; k++) task->sums[k * n + r] = lanes->row[SUMS + k][lane];
  if (task->status) task->status[r] = lanes->integer[LOST][lane] ? STATUS_LOST : 0;
  if (!task->where) return;
  task->where[r] = lanes->integer[WHERE][lane];
  task->where[n + r] = lanes->integer[SLAB][lane];
}

static void clear_rays(real *rows, int count, int64_t n, int64_t first, int rays) {
  for (int k = 0; k < count; k++) memset(rows + k * n + first, 0, rays * sizeof(real));
}

/* Results of rays that meet nothing; and what lanes start with, beside zeros. */
static void begin_pixels(Task *task, Lanes *lanes, int n, int64_t first, int count) {
  clear_rays(task->sums, 8, task->count, first, count);
  if (task->status) memset(task->status + first, 0, count * sizeof(int32_t));
  if (!task->where) return;
  memset(task->where + first, -1, count * sizeof(int32_t));
  memset(task->where + task->count + first, 0, count * sizeof(int32_t));
  begin_whole(lanes, n);
}

static void render_block(void *data, int k) {
  Task *task = data;
  const World *world = &task->world;
  const Optics *optics = &task->optics;
  int64_t first = (int64_t)k * LANES;
  int count = rays_in(task, first);
  Block *block = new_block(task);
  if (!block) return;
  fill_block(world, block, first, count, ROWS);
  begin_pixels(task, &block->lanes, block->n, first, count);
  while (goes_on(world, block)) {
    arrive(world, &block->lanes, block->n);
    composite_segments(optics, &block->lanes, block->n);
    leave(&world->mesh, &block->lanes, block->n);
    settle(world, block, ROWS, optics->enough, keep_sums, task);
  }
  free(block);
}

static void shade_block(void *data, int k) {
  Task *task = data;
  const Optics *optics = &task->optics;
  int64_t first = (int64_t)k * LANES;
  int count = rays_in(task, first);
  Block *block = new_block(task);
  if (!block) return;
  Lanes *lanes = &block->lanes;
  int n = fill_runs(&task->nodes, lanes, first, count, ROWS);
  begin_pixels(task, lanes, n, first, count);
  while (n > 0 && !is_over(&task->watch)) {
    play(&task->nodes, lanes, n);
    composite_segments(optics, lanes, n);
    n = settle_runs(lanes, n, ROWS, optics->enough, keep_sums, task);
  }
  free(block);
}

/* ---- derivatives ---- */

/* Final sums and cotangents of the lanes' pixels. */
static void load_pixels(const Task *task, Lanes *lanes, int n) {
  for (int i = 0; i < n; i++) {
    int64_t r = lanes->integer[RAY][i];
    for (int k = 0; k < 8; k++) lanes->row[FINAL + k][i] = task->finals[k * task->count + r];
    for (int k = 0; k < 4; k++) lanes->row[PIXEL + k][i] = task->pixel_bar[k * task->count + r];
    if (task->goal) lanes->integer[WHERE][i] = task->goal[r], lanes->integer[SLAB][i] = 0;
  }
}

/* What one thread pulls back with: memory of its own, and the share that it has at the time. */
typedef struct {
  Task *task;
  Block *block;
  CellBar *bar;
  Share *share;
} Worker;

static void keep_bars(void *data, Lanes *lanes, int lane) {
  Worker *worker = data;
  Task *task = worker->task;
  int64_t n = task->count, r = lanes->integer[RAY][lane];
  double *table = worker->share->table;
  if (table) hand_in(&task->optics.transfer, lanes, lane, table);
  for (int k = 0; task->rays_bar && k < RAY_BARS; k++)
    task->rays_bar[k * n + r] = lanes->row[RBAR + k][lane];
}

static void pull_block(Worker *worker, int64_t first) {
  Task *task = worker->task;
  Share *share = worker->share;
  const World *world = &task->world;
  const Optics *optics = &task->optics;
  Block *block = worker->block;
  Lanes *lanes = &block->lanes;
  if (task->rays_bar) clear_rays(task->rays_bar, RAY_BARS, task->count, first, rays_in(task, first));
  fill_block(world, block, first, rays_in(task, first), ALL_ROWS);
  load_pixels(task, lanes, block->n);
  while (goes_on(world, block)) {
    int n = block->n;
    arrive(world, lanes, n);
    pull_segments(optics, lanes, n, share->table);
    if (share->vertices.sum || task->rays_bar)
      pull_cells(lanes, n, worker->bar, world->rays.bounds != NULL);
    if (share->vertices.sum)
      scatter_cells(&world->mesh, lanes, n, worker->bar, &share->vertices, &share->values);
    if (share->vertices.sum || task->rays_bar)
      pull_starts(&world->mesh, block, worker->bar, &share->vertices);
    leave(&world->mesh, lanes, n);
    settle(world, block, ALL_ROWS, optics->enough, keep_bars, worker);
  }
}

static void pull_run_block(Worker *worker, int64_t first) {
  Task *task = worker->task;
  const Optics *optics = &task->optics;
  Lanes *lanes = &worker->block->lanes;
  int n = fill_runs(&task->nodes, lanes, first, rays_in(task, first), ALL_ROWS);
  load_pixels(task, lanes, n);
  while (n > 0 && !is_over(&task->watch)) {
    play(&task->nodes, lanes, n);
    pull_segments(optics, lanes, n, worker->share->table);
    scatter_nodes(lanes, n, task->scalar, task->length);
    n = settle_runs(lanes, n, ALL_ROWS, optics->enough, keep_bars, worker);
  }
}

/* The next group, with a share for it; NULL if there is none left. The group is taken when there is
 * a share, so that the one whose turn it is always has one. */
static Share *take_group(Task *task) {
  Turns *turns = &task->turns;
  for (;; sched_yield()) {
    Share *found = NULL;
    pthread_mutex_lock(&turns->lock);
    int left = turns->next < turns->groups && !is_over(&task->watch);
    for (int k = 0; left && !found && k < turns->count; k++)
      if (turns->shares[k].state == FREE) found = turns->shares + k;
    if (found) found->state = TAKEN, found->group = turns->next++;
    pthread_mutex_unlock(&turns->lock);
    if (found || !left) return found;
  }
}

/* Adds what a part has where it was added to, and clears it. */
static void add_part(real *restrict sum, Part *part) {
  real *restrict own = part->sum;
  for (int64_t k = 0; k * CHUNK < part->size; k++) {
    if (!part->touched[k]) continue;
    part->touched[k] = 0;
    int64_t end = (k + 1) * CHUNK < part->size ? (k + 1) * CHUNK : part->size;
    for (int64_t i = k * CHUNK; i < end; i++) sum[i] += own[i], own[i] = 0;
  }
}

static void add_share(Task *task, Share *share) {
  for (int64_t i = 0; share->table && i < task->table_size; i++) {
    task->table_bar[i] += share->table[i];
    share->table[i] = 0;
  }
  if (!share->vertices.sum) return;
  add_part(task->vertices_bar, &share->vertices);
  add_part(task->values_bar, &share->values);
}

/* A group is done: it is added, and those behind it that have waited, if it is its turn. */
static void hand_back(Task *task, Share *share) {
  Turns *turns = &task->turns;
  pthread_mutex_lock(&turns->lock);
  share->state = DONE;
  for (int k = 0; !turns->adding && k < turns->count; k++) {
    Share *next = turns->shares + k;
    if (next->state != DONE || next->group != turns->turn) continue;
    turns->adding = 1;
    pthread_mutex_unlock(&turns->lock);
    add_share(task, next);
    pthread_mutex_lock(&turns->lock);
    next->state = FREE;
    turns->adding = 0;
    turns->turn++;
    k = -1; /* look again from the first on */
  }
  pthread_mutex_unlock(&turns->lock);
}

static void pull_groups(void *data, int k) {
  (void)k;
  Task *task = data;
  Worker worker = {task, new_block(task), aligned(sizeof(CellBar)), NULL};
  int64_t blocks = blocks_of(task->count);
  if (!worker.bar) atomic_store(&task->watch.failed, 1);
  while ((worker.share = take_group(task))) {
    int64_t from = blocks * worker.share->group / task->turns.groups;
    int64_t to = blocks * (worker.share->group + 1) / task->turns.groups;
    for (; from < to && !is_over(&task->watch); from++)
      if (task->nodes.scalar) pull_run_block(&worker, from * LANES);
      else pull_block(&worker, from * LANES);
    hand_back(task, worker.share);
  }
  free(worker.block);
  free(worker.bar);
}

/* Gradients that are not asked for have no numbers. */
static int64_t size_of(XLA_FFI_CallFrame *frame, int k) {
  XLA_FFI_Buffer *buffer = frame->rets.rets[k];
  int64_t size = 1;
  for (int64_t i = 0; i < buffer->rank; i++) size *= buffer->dims[i];
  return size;
}

/* Runs `work` on 0 to count - 1. Broken indices are left to the caller. */
static Failure run(XLA_FFI_CallFrame *frame, int count, void (*work)(void *, int), Task *task) {
  task->world.mesh.watch = task->nodes.watch = &task->watch;
  watch_begin();
  Failure failure = in_parallel(frame, count, work, task);
  int ended = watch_end();
  if (failure) return failure;
  if (atomic_load(&task->watch.failed)) return no_memory(frame);
  return ended ? fail(frame, XLA_FFI_Error_Code_CANCELLED, "jaxvr: interrupted") : NULL;
}

/* What has no status says that indices are out of range by an error. */
static Failure run_or_fail(XLA_FFI_CallFrame *frame, int count, void (*work)(void *, int),
                           Task *task) {
  Failure failure = run(frame, count, work, task);
  if (failure || !atomic_load(&task->watch.broken)) return failure;
  return fail(frame, XLA_FFI_Error_Code_INVALID_ARGUMENT,
              "jaxvr: integers of the volume or the segments are out of range or do not fit "
              "together. Were they computed with?");
}

/* All rays of a mesh whose integers cannot be right say so. */
static void mark_broken(Task *task) {
  if (!atomic_load(&task->watch.broken)) return;
  for (int64_t r = 0; r < task->count; r++) task->status[r] = STATUS_BROKEN;
  if (task->sums) memset(task->sums, 0, 8 * task->count * sizeof(real));
  if (task->where) memset(task->where, -1, task->count * sizeof(int32_t));
  if (task->number) memset(task->number, 0, task->count * sizeof(int32_t));
}

/* How many groups: by the number of rays alone. Enough for many threads to share them evenly. */
#define GROUPS 64
static Failure pull(XLA_FFI_CallFrame *frame, Task *task) {
  int64_t blocks = blocks_of(task->count);
  int threads = thread_count(frame), groups = blocks < GROUPS ? (int)blocks : GROUPS;
  if (threads > groups) threads = groups;
  int count = threads > 1 ? threads + 1 + threads / 4 : 1;
  if (count > groups) count = groups;
  int64_t chunks[] = {task->vertices_size / CHUNK + 1, task->values_size / CHUNK + 1};
  int64_t numbers = task->vertices_size + task->values_size;
  Share *shares = calloc(count + 1, sizeof(Share));
  double *tables = calloc((count + 1) * task->table_size + 1, sizeof(double));
  real *sums = calloc(count * numbers + 1, sizeof(real));
  char *touched = calloc(count * (chunks[0] + chunks[1]) + 1, 1);
  Failure failure = NULL;
  if (shares && tables && sums && touched) {
    for (int k = 0; k < count; k++) {
      Share *share = shares + k;
      share->table = task->table_size ? tables + (k + 1) * task->table_size : NULL;
      if (!numbers) continue;
      char *marks = touched + k * (chunks[0] + chunks[1]);
      share->vertices = (Part){sums + k * numbers, marks, task->vertices_size};
      share->values =
          (Part){sums + k * numbers + task->vertices_size, marks + chunks[0], task->values_size};
    }
    task->table_bar = tables;
    task->turns = (Turns){PTHREAD_MUTEX_INITIALIZER, groups, 0, 0, 0, count, shares};
    failure = run_or_fail(frame, threads, pull_groups, task);
    real *out = result(frame, 0);
    for (int64_t i = 0; i < task->table_size; i++) out[i] = (real)tables[i];
  } else failure = no_memory(frame);
  free(shares);
  free(tables);
  free(sums);
  free(touched);
  return failure;
}

/* ---- what XLA calls ---- */

EXPORT void jaxvr_listen(int yes) { atomic_store(&listens, yes); }

EXPORT Failure jaxvr_render(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.world = world_of(frame), .optics = optics_of(frame, 11),
               .sums = result(frame, 0), .status = result(frame, 1)};
  task.count = task.world.rays.count;
  task.where = size_of(frame, 2) ? result(frame, 2) : NULL;
  Failure failure = run(frame, blocks_of(task.count), render_block, &task);
  mark_broken(&task);
  return failure;
}

EXPORT Failure jaxvr_shade(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.nodes = nodes_of(frame), .optics = optics_of(frame, 4),
               .count = extent(frame, 2, 0), .sums = result(frame, 0)};
  task.where = size_of(frame, 1) ? result(frame, 1) : NULL;
  return run_or_fail(frame, blocks_of(task.count), shade_block, &task);
}

/* Results: table (2 K, NODE_PAIR), vertices (P, 4), values, rays (RAY_BARS, N). */
EXPORT Failure jaxvr_render_pull(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.world = world_of(frame), .optics = optics_of(frame, 11),
               .finals = argument(frame, 16), .pixel_bar = argument(frame, 17),
               .vertices_bar = result(frame, 1), .values_bar = result(frame, 2),
               .table_size = size_of(frame, 0), .vertices_size = size_of(frame, 1),
               .values_size = size_of(frame, 2)};
  task.count = task.world.rays.count;
  task.rays_bar = size_of(frame, 3) ? result(frame, 3) : NULL;
  task.goal = extent(frame, 18, 0) ? argument(frame, 18) : NULL;
  memset(task.vertices_bar, 0, task.vertices_size * sizeof(real));
  memset(task.values_bar, 0, task.values_size * sizeof(real));
  return pull(frame, &task);
}

/* Results: table (2 K, NODE_PAIR), scalar (N,), length (N,) of the nodes. */
EXPORT Failure jaxvr_shade_pull(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.nodes = nodes_of(frame), .optics = optics_of(frame, 4),
               .count = extent(frame, 2, 0), .finals = argument(frame, 9),
               .pixel_bar = argument(frame, 10), .table_size = size_of(frame, 0)};
  task.goal = extent(frame, 11, 0) ? argument(frame, 11) : NULL;
  int64_t scalars = size_of(frame, 1), lengths = size_of(frame, 2);
  task.scalar = scalars ? memset(result(frame, 1), 0, scalars * sizeof(real)) : NULL;
  task.length = lengths ? memset(result(frame, 2), 0, lengths * sizeof(real)) : NULL;
  return pull(frame, &task);
}

/* ---- segments to be kept ---- */

static void keep_number(void *data, Lanes *lanes, int lane) {
  Task *task = data;
  int64_t r = lanes->integer[RAY][lane];
  task->number[r] = lanes->integer[SLAB][lane];
  task->status[r] = lanes->integer[LOST][lane] ? STATUS_LOST : 0;
}

static void keep_nothing(void *data, Lanes *lanes, int lane) {
  (void)data, (void)lanes, (void)lane;
}

/* SLAB counts a lane's nodes: a segment is one, and one more where it starts at another scalar. */
static void count_block(void *data, int k) {
  Task *task = data;
  int64_t first = (int64_t)k * LANES;
  int count = rays_in(task, first);
  Block *block = new_block(task);
  if (!block) return;
  Lanes *lanes = &block->lanes;
  memset(task->number + first, 0, count * sizeof(int32_t));
  memset(task->status + first, 0, count * sizeof(int32_t));
  fill_block(&task->world, block, first, count, ROWS);
  while (goes_on(&task->world, block)) {
    arrive(&task->world, lanes, block->n);
    for (int i = 0; i < block->n; i++)
      if (!lanes->integer[LOST][i]) lanes->integer[SLAB][i] += 1 + (lanes->integer[FRESH][i] != 0);
    leave(&task->world.mesh, lanes, block->n);
    settle(&task->world, block, ROWS, INFINITY, keep_number, task);
  }
  free(block);
}

static void fill_nodes_block(void *data, int k) {
  Task *task = data;
  int64_t first = (int64_t)k * LANES;
  Block *block = new_block(task);
  if (!block) return;
  Lanes *lanes = &block->lanes;
  fill_block(&task->world, block, first, rays_in(task, first), ROWS);
  for (int i = 0; i < block->n; i++) lanes->integer[SLAB][i] = task->start[lanes->integer[RAY][i]];
  while (goes_on(&task->world, block)) {
    arrive(&task->world, lanes, block->n);
    for (int i = 0; i < block->n; i++) {
      if (lanes->integer[LOST][i]) continue;
      int64_t at = lanes->integer[SLAB][i], needed = 1 + (lanes->integer[FRESH][i] != 0);
      if (at < 0 || at + needed > task->total) {
        is_broken(&task->watch);
        break;
      }
      if (lanes->integer[FRESH][i]) {
        task->scalar[at] = lanes->row[FRONT][i];
        task->length[at++] = 0;
      }
      task->scalar[at] = lanes->row[BACK][i];
      task->length[at++] = lanes->row[LENGTH][i];
      lanes->integer[SLAB][i] = (int32_t)at;
    }
    leave(&task->world.mesh, lanes, block->n);
    settle(&task->world, block, ROWS, INFINITY, keep_nothing, task);
  }
  free(block);
}

EXPORT Failure jaxvr_count(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.world = world_of(frame), .number = result(frame, 0), .status = result(frame, 1)};
  task.count = task.world.rays.count;
  Failure failure = run(frame, blocks_of(task.count), count_block, &task);
  mark_broken(&task);
  return failure;
}

/* Only of the first rays, as many as have a start: the rest are copies that fill a batch. */
EXPORT Failure jaxvr_fill(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.world = world_of(frame), .start = argument(frame, 11),
               .scalar = result(frame, 0), .length = result(frame, 1),
               .total = size_of(frame, 0), .count = extent(frame, 11, 0)};
  memset(task.scalar, 0, size_of(frame, 0) * sizeof(real));
  memset(task.length, 0, size_of(frame, 1) * sizeof(real));
  return run_or_fail(frame, blocks_of(task.count), fill_nodes_block, &task);
}
