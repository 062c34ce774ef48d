/* The thin layer to XLA: buffers of a typed FFI call, its errors, and its threads. */
#ifndef JAXVR_PARALLEL_H
#define JAXVR_PARALLEL_H

#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>

#include "xla/ffi/api/c_api.h"

typedef XLA_FFI_Error *Failure;
#define EXPORT __attribute__((visibility("default")))

static inline void *argument(XLA_FFI_CallFrame *frame, int k) {
  return ((XLA_FFI_Buffer *)frame->args.args[k])->data;
}

static inline int64_t extent(XLA_FFI_CallFrame *frame, int k, int axis) {
  return ((XLA_FFI_Buffer *)frame->args.args[k])->dims[axis];
}

static inline void *result(XLA_FFI_CallFrame *frame, int k) {
  return ((XLA_FFI_Buffer *)frame->rets.rets[k])->data;
}

/* Answers XLA's question which version of its interface this was compiled for. (The extension's
 * type is not named: it has another name in jaxlib 0.11.1 and later.) */
static inline int asks_metadata(XLA_FFI_CallFrame *frame) {
  if (!frame->extension_start || frame->extension_start->type != XLA_FFI_Extension_Metadata)
    return 0;
  XLA_FFI_Metadata *metadata = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
  metadata->api_version.major_version = XLA_FFI_API_MAJOR;
  metadata->api_version.minor_version = XLA_FFI_API_MINOR;
  return 1;
}

static inline Failure fail(XLA_FFI_CallFrame *frame, XLA_FFI_Error_Code code, const char *why) {
  XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, why, code};
  return frame->api->XLA_FFI_Error_Create(&args);
}

static inline Failure no_memory(XLA_FFI_CallFrame *frame) {
  return fail(frame, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED,
              "jaxvr: no memory left for a block of rays");
}

/* Pieces of work 0 to count - 1, taken by whoever is free. XLA's threads may come late or never:
 * the caller works too, and waits only for what has been begun. */
typedef struct {
  void (*work)(void *, int);
  void *data;
  int count;
  atomic_int next, finished, holders;
} Job;

static inline void take_part(Job *job) {
  for (int k; (k = atomic_fetch_add(&job->next, 1)) < job->count;) {
    job->work(job->data, k);
    atomic_fetch_add(&job->finished, 1);
  }
}

static inline void let_go(Job *job) {
  if (atomic_fetch_sub(&job->holders, 1) == 1) free(job);
}

static void join_in(void *job) {
  take_part(job);
  let_go(job);
}

static inline int thread_count(XLA_FFI_CallFrame *frame) {
  int64_t threads = 1;
  XLA_FFI_ThreadPool_NumThreads_Args args = {XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE, NULL,
                                             frame->ctx, &threads};
  Failure failure = frame->api->XLA_FFI_ThreadPool_NumThreads(&args);
  if (failure) {
    XLA_FFI_Error_Destroy_Args destroy = {XLA_FFI_Error_Destroy_Args_STRUCT_SIZE, NULL, failure};
    frame->api->XLA_FFI_Error_Destroy(&destroy);
    return 1;
  }
  return threads < 1 ? 1 : threads > 1024 ? 1024 : (int)threads;
}

static Failure in_parallel(XLA_FFI_CallFrame *frame, int count, void (*work)(void *, int),
                           void *data) {
  int helpers = thread_count(frame) - 1;
  if (helpers > count - 1) helpers = count - 1;
  Job *job = malloc(sizeof *job);
  if (!job) return no_memory(frame);
  job->work = work, job->data = data, job->count = count;
  atomic_init(&job->next, 0);
  atomic_init(&job->finished, 0);
  atomic_init(&job->holders, helpers + 1);
  for (int k = 0; k < helpers; k++) {
    XLA_FFI_ThreadPool_Schedule_Args args = {XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE, NULL,
                                             frame->ctx, join_in, job};
    Failure failure = frame->api->XLA_FFI_ThreadPool_Schedule(&args);
    if (failure) { /* no pool: the caller does it all */
      XLA_FFI_Error_Destroy_Args destroy = {XLA_FFI_Error_Destroy_Args_STRUCT_SIZE, NULL, failure};
      frame->api->XLA_FFI_Error_Destroy(&destroy);
      let_go(job);
    }
  }
  take_part(job);
  while (atomic_load(&job->finished) < count) sched_yield();
  let_go(job);
  return NULL;
}

#endif
