/* What ends the loops early: Ctrl-C, and integers that no mesh has.
 *
 * Integers of a mesh under a user's jit may be anything: an average of two meshes, a step over all
 * leaves. Each is compared with what it counts as it is loaded, and replaced by 0 where it is out of
 * range; and no block takes more steps than there are cells, since a ray is in a cell once (see
 * trace/raycast.py). Either ends all blocks.
 *
 * Python learns of Ctrl-C when the main thread comes back to it, which waits for XLA. So while a
 * loop runs, SIGINT has a handler of ours, which makes a note and calls the one before. */
#ifndef JAXVR_WATCH_H
#define JAXVR_WATCH_H

#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdint.h>

/* Of one call. */
typedef struct {
  atomic_int broken, failed; /* integers out of range; no memory */
} Watch;

static atomic_int interrupted; /* since the first of the calls that now run */
static struct {
  pthread_mutex_t lock;
  int calls, installed;
  struct sigaction before;
} signals = {.lock = PTHREAD_MUTEX_INITIALIZER};
static atomic_int listens; /* whether Ctrl-C ends loops: Python says so */

static void on_interrupt(int number, siginfo_t *info, void *context) {
  atomic_store(&interrupted, 1);
  if (signals.before.sa_flags & SA_SIGINFO) signals.before.sa_sigaction(number, info, context);
  else signals.before.sa_handler(number);
}

static int is_handled(const struct sigaction *action) {
  if (action->sa_flags & SA_SIGINFO) return action->sa_sigaction != on_interrupt;
  return action->sa_handler != SIG_DFL && action->sa_handler != SIG_IGN;
}

static void watch_begin(void) {
  struct sigaction now;
  pthread_mutex_lock(&signals.lock);
  if (signals.calls++ == 0) {
    atomic_store(&interrupted, 0);
    if (atomic_load(&listens) && !sigaction(SIGINT, NULL, &now) && is_handled(&now)) {
      signals.before = now;
      now.sa_flags |= SA_SIGINFO;
      now.sa_sigaction = on_interrupt;
      signals.installed = !sigaction(SIGINT, &now, NULL);
    }
  }
  pthread_mutex_unlock(&signals.lock);
}

/* Puts the handler back, unless there is another one by now. Returns whether there was a Ctrl-C. */
static int watch_end(void) {
  struct sigaction now;
  pthread_mutex_lock(&signals.lock);
  int ended = atomic_load(&interrupted);
  if (--signals.calls == 0 && signals.installed) {
    signals.installed = 0;
    if (!sigaction(SIGINT, NULL, &now) && (now.sa_flags & SA_SIGINFO) &&
        now.sa_sigaction == on_interrupt)
      sigaction(SIGINT, &signals.before, NULL);
  }
  pthread_mutex_unlock(&signals.lock);
  return ended;
}

static inline int is_over(Watch *watch) {
  return atomic_load_explicit(&interrupted, memory_order_relaxed) |
         atomic_load_explicit(&watch->broken, memory_order_relaxed) |
         atomic_load_explicit(&watch->failed, memory_order_relaxed);
}

static inline void is_broken(Watch *watch) {
  atomic_store_explicit(&watch->broken, 1, memory_order_relaxed);
}

/* index, or 0 if it is not among `count`, which is a break. */
static inline int32_t within(Watch *watch, int32_t index, int64_t count) {
  if ((uint64_t)(int64_t)index < (uint64_t)count) return index;
  is_broken(watch);
  return 0;
}

#endif
