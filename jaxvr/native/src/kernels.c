/* The loops that XLA calls. Arrays are described in native/kernels.py, which passes them. */
#include "parallel.h"
#include "play.h"
#include "pull.h"
#include "walk.h"

typedef struct {
  Transfer transfer;
  Rule rule;
  real enough;
} Optics;

/* Everything that a block of rays needs; a kernel fills what it uses. */
typedef struct {
  World world;
  Nodes nodes;
  Optics optics;
  int64_t count; /* rays */
  atomic_int failed;
  /* results of a picture, (8, N) and (N,) */
  real *sums;
  int32_t *status;
  /* of the number of nodes, and the nodes themselves from `start` (N,) on */
  int32_t *number;
  const int32_t *start;
  real *scalar, *length;
  /* operands of derivatives: sums, the pixels' cotangents (4, N); and gradients, or NULL */
  const real *finals, *pixel_bar;
  real *vertices_bar, *values_bar, *rays_bar;
  double *table_bar;
  /* `groups` of blocks take turns, each with gradients of its own, one behind the other */
  int groups;
  int64_t table_size, vertices_size, values_size;
} Task;

/* vertices, values, cells, neighbors, low, high, faces, axes, numbers, options: arguments 0 to 9. */
static World world_of(XLA_FFI_CallFrame *frame) {
  const int32_t *options = argument(frame, 9);
  World world = {
      {argument(frame, 0), argument(frame, 1), argument(frame, 2), argument(frame, 3), options[0],
       options[1]},
      {argument(frame, 4), argument(frame, 5), argument(frame, 6), extent(frame, 6, 0)},
      {extent(frame, 7, 1), argument(frame, 7), argument(frame, 8)},
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
  return optics;
}

static Nodes nodes_of(XLA_FFI_CallFrame *frame) {
  Nodes nodes = {argument(frame, 0), argument(frame, 1), argument(frame, 2), argument(frame, 3)};
  return nodes;
}

static int blocks_of(int64_t rays) { return (int)((rays + LANES - 1) / LANES); }

static int rays_in(const Task *task, int64_t first) {
  return task->count - first < LANES ? (int)(task->count - first) : LANES;
}

static void *aligned(size_t size) { return aligned_alloc(64, (size + 63) / 64 * 64); }

/* A block's memory, or NULL with the task marked as failed. */
static Block *new_block(Task *task) {
  Block *block = aligned(sizeof(Block));
  if (!block) atomic_store(&task->failed, 1);
  return block;
}

/* ---- pictures ---- */

static void keep_sums(void *data, Lanes *lanes, int lane) {
  Task *task = data;
  int64_t n = task->count, r = lanes->integer[RAY][lane];
  for (int k = 0; k < 8; k++) task->sums[k * n + r] = lanes->row[SUMS + k][lane];
  if (task->status) task->status[r] = lanes->integer[LOST][lane] ? STATUS_LOST : 0;
}

static void clear_rays(real *rows, int count, int64_t n, int64_t first, int rays) {
  for (int k = 0; k < count; k++) memset(rows + k * n + first, 0, rays * sizeof(real));
}

static void render_block(void *data, int k) {
  Task *task = data;
  const World *world = &task->world;
  const Optics *optics = &task->optics;
  int64_t first = (int64_t)k * LANES;
  int count = rays_in(task, first);
  Block *block = new_block(task);
  if (!block) return;
  clear_rays(task->sums, 8, task->count, first, count);
  memset(task->status + first, 0, count * sizeof(int32_t));
  fill_block(world, block, first, count, ROWS);
  while (block->n) {
    arrive(&world->mesh, &block->lanes, block->n);
    shade(&optics->transfer, &optics->rule, &block->lanes, block->n);
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
  clear_rays(task->sums, 8, task->count, first, count);
  for (int n = fill_runs(&task->nodes, lanes, first, count, ROWS); n > 0;) {
    play(&task->nodes, lanes, n);
    shade(&optics->transfer, &optics->rule, lanes, n);
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
    lanes->row[PIXEL + 3][i] *= exp_minus(lanes->row[FINAL][i], lanes->row[FINAL + 4][i]);
  }
}

/* One of the groups of blocks, with its share of the memory for gradients. */
typedef struct {
  Task *task;
  Block *block;
  CellBar *bar;
  double *table;
  real *vertices, *values;
} Group;

static void keep_bars(void *data, Lanes *lanes, int lane) {
  Group *group = data;
  Task *task = group->task;
  int64_t n = task->count, r = lanes->integer[RAY][lane];
  if (group->table) hand_in(&task->optics.transfer, lanes, lane, group->table);
  for (int k = 0; task->rays_bar && k < 6; k++)
    task->rays_bar[k * n + r] = lanes->row[RBAR + k][lane];
}

static void pull_block(Group *group, int64_t first) {
  Task *task = group->task;
  const World *world = &task->world;
  const Optics *optics = &task->optics;
  Block *block = group->block;
  Lanes *lanes = &block->lanes;
  if (task->rays_bar) clear_rays(task->rays_bar, 6, task->count, first, rays_in(task, first));
  fill_block(world, block, first, rays_in(task, first), ALL_ROWS);
  load_pixels(task, lanes, block->n);
  while (block->n) {
    int n = block->n;
    arrive(&world->mesh, lanes, n);
    pull_shading(&optics->transfer, &optics->rule, lanes, n, group->table);
    if (group->vertices || task->rays_bar) pull_cells(lanes, n, group->bar);
    if (group->vertices)
      scatter_cells(&world->mesh, lanes, n, group->bar, group->vertices, group->values);
    if (group->vertices || task->rays_bar)
      pull_starts(&world->mesh, block, group->bar, group->vertices);
    leave(&world->mesh, lanes, n);
    settle(world, block, ALL_ROWS, optics->enough, keep_bars, group);
  }
}

static void pull_run_block(Group *group, int64_t first) {
  Task *task = group->task;
  const Optics *optics = &task->optics;
  Lanes *lanes = &group->block->lanes;
  int n = fill_runs(&task->nodes, lanes, first, rays_in(task, first), ALL_ROWS);
  load_pixels(task, lanes, n);
  while (n > 0) {
    play(&task->nodes, lanes, n);
    pull_shading(&optics->transfer, &optics->rule, lanes, n, group->table);
    scatter_nodes(lanes, n, task->scalar, task->length);
    n = settle_runs(lanes, n, ALL_ROWS, optics->enough, keep_bars, group);
  }
}

/* Blocks g, g + groups, ... into the gradients of group g: the order of sums is always the same. */
static void pull_group(void *data, int g) {
  Task *task = data;
  Group group = {task, new_block(task), aligned(sizeof(CellBar)), NULL, NULL, NULL};
  if (task->table_bar) group.table = task->table_bar + g * task->table_size;
  if (task->vertices_bar) group.vertices = task->vertices_bar + g * task->vertices_size;
  if (task->values_bar) group.values = task->values_bar + g * task->values_size;
  if (!group.bar) atomic_store(&task->failed, 1);
  for (int64_t k = g; !atomic_load(&task->failed) && k * LANES < task->count; k += task->groups)
    if (task->nodes.scalar) pull_run_block(&group, k * LANES);
    else pull_block(&group, k * LANES);
  free(group.block);
  free(group.bar);
}

/* Sums the groups' gradients: part k of many. */
#define PARTS 64
static void sum_part(void *data, int k) {
  Task *task = data;
  real *sets[] = {task->vertices_bar, task->values_bar};
  int64_t sizes[] = {task->vertices_size, task->values_size};
  for (int s = 0; s < 2; s++) {
    if (!sets[s]) continue;
    int64_t from = sizes[s] * k / PARTS, to = sizes[s] * (k + 1) / PARTS;
    for (int g = 1; g < task->groups; g++) {
      const real *restrict other = sets[s] + g * sizes[s];
      real *restrict sum = sets[s];
      for (int64_t i = from; i < to; i++) sum[i] += other[i];
    }
  }
}

/* Gradients that are not asked for have no numbers. */
static int64_t size_of(XLA_FFI_CallFrame *frame, int k) {
  XLA_FFI_Buffer *buffer = frame->rets.rets[k];
  int64_t size = 1;
  for (int64_t i = 0; i < buffer->rank; i++) size *= buffer->dims[i];
  return size;
}

/* The table's gradient, result 0, from those of the groups in double precision. */
static void sum_tables(XLA_FFI_CallFrame *frame, const Task *task) {
  real *out = result(frame, 0);
  for (int64_t i = 0; i < task->table_size; i++) {
    double sum = 0;
    for (int g = 0; g < task->groups; g++) sum += task->table_bar[g * task->table_size + i];
    out[i] = (real)sum;
  }
}

static Failure finish(XLA_FFI_CallFrame *frame, Task *task, Failure failure) {
  if (failure) return failure;
  return atomic_load(&task->failed) ? no_memory(frame) : NULL;
}

/* ---- what XLA calls ---- */

EXPORT Failure jaxvr_render(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.world = world_of(frame), .optics = optics_of(frame, 10),
               .sums = result(frame, 0), .status = result(frame, 1)};
  task.count = task.world.rays.count;
  return finish(frame, &task, in_parallel(frame, blocks_of(task.count), render_block, &task));
}

EXPORT Failure jaxvr_shade(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.nodes = nodes_of(frame), .optics = optics_of(frame, 4),
               .count = extent(frame, 2, 0), .sums = result(frame, 0)};
  return finish(frame, &task, in_parallel(frame, blocks_of(task.count), shade_block, &task));
}

/* Results: table (2 K, NODE_PAIR), vertices (P, 4), values, rays (6, N). */
EXPORT Failure jaxvr_render_pull(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.world = world_of(frame), .optics = optics_of(frame, 10),
               .finals = argument(frame, 15), .pixel_bar = argument(frame, 16),
               .groups = thread_count(frame), .table_size = size_of(frame, 0),
               .vertices_size = size_of(frame, 1), .values_size = size_of(frame, 2)};
  task.count = task.world.rays.count;
  task.rays_bar = size_of(frame, 3) ? result(frame, 3) : NULL;
  int64_t all = task.vertices_size + task.values_size;
  double *tables = calloc(task.groups * task.table_size + 1, sizeof(double));
  real *scene = calloc(task.groups * all + 1, sizeof(real));
  Failure failure = NULL;
  if (tables && scene) {
    if (task.table_size) task.table_bar = tables;
    if (all) task.vertices_bar = scene, task.values_bar = scene + task.groups * task.vertices_size;
    failure = in_parallel(frame, task.groups, pull_group, &task);
    if (!failure && all) {
      failure = in_parallel(frame, PARTS, sum_part, &task);
      memcpy(result(frame, 1), task.vertices_bar, task.vertices_size * sizeof(real));
      memcpy(result(frame, 2), task.values_bar, task.values_size * sizeof(real));
    }
    if (task.table_bar) sum_tables(frame, &task);
  } else atomic_store(&task.failed, 1);
  free(tables);
  free(scene);
  return finish(frame, &task, failure);
}

/* Results: table (2 K, NODE_PAIR), scalar (N,), length (N,) of the nodes. */
EXPORT Failure jaxvr_shade_pull(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.nodes = nodes_of(frame), .optics = optics_of(frame, 4),
               .count = extent(frame, 2, 0), .finals = argument(frame, 9),
               .pixel_bar = argument(frame, 10), .groups = thread_count(frame),
               .table_size = size_of(frame, 0)};
  int64_t scalars = size_of(frame, 1), lengths = size_of(frame, 2);
  task.scalar = scalars ? memset(result(frame, 1), 0, scalars * sizeof(real)) : NULL;
  task.length = lengths ? memset(result(frame, 2), 0, lengths * sizeof(real)) : NULL;
  double *tables = calloc(task.groups * task.table_size + 1, sizeof(double));
  if (!tables) return no_memory(frame);
  task.table_bar = task.table_size ? tables : NULL;
  Failure failure = in_parallel(frame, task.groups, pull_group, &task);
  if (task.table_bar) sum_tables(frame, &task);
  free(tables);
  return finish(frame, &task, failure);
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
  while (block->n) {
    arrive(&task->world.mesh, lanes, block->n);
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
  while (block->n) {
    arrive(&task->world.mesh, lanes, block->n);
    for (int i = 0; i < block->n; i++) {
      if (lanes->integer[LOST][i]) continue;
      int at = lanes->integer[SLAB][i];
      if (lanes->integer[FRESH][i]) {
        task->scalar[at] = lanes->row[FRONT][i];
        task->length[at++] = 0;
      }
      task->scalar[at] = lanes->row[BACK][i];
      task->length[at++] = lanes->row[LENGTH][i];
      lanes->integer[SLAB][i] = at;
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
  return finish(frame, &task, in_parallel(frame, blocks_of(task.count), count_block, &task));
}

EXPORT Failure jaxvr_fill(XLA_FFI_CallFrame *frame) {
  if (asks_metadata(frame)) return NULL;
  Task task = {.world = world_of(frame), .start = argument(frame, 10),
               .scalar = result(frame, 0), .length = result(frame, 1)};
  task.count = task.world.rays.count;
  memset(task.scalar, 0, size_of(frame, 0) * sizeof(real));
  memset(task.length, 0, size_of(frame, 1) * sizeof(real));
  return finish(frame, &task, in_parallel(frame, blocks_of(task.count), fill_nodes_block, &task));
}
