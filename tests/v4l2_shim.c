// Emulated V4L2 cameras for tests, by LD_PRELOAD: no kernel support, no root.
//
//   cc -O2 -shared -fPIC -o v4l2_shim.so v4l2_shim.c -ldl -lpthread
//   V4L2_SHIM_DIR=DIR LD_PRELOAD=./v4l2_shim.so PROGRAM
//
// tests/v4l2_emulator.py builds it and writes DIR; this is what it reads there:
//
//   DIR/dev/videoN            an empty file = the camera is plugged in; deleting it unplugs the
//                             camera also for who has it open, creating it plugs one in
//   DIR/dev/v4l/by-id/NAME    a link to ../../videoN
//   DIR/videoN/modes          a line a mode: FOURCC WIDTH HEIGHT RATE[,RATE...] [stride=BYTES]
//                             [full] (full range); the first is the default, reread at each open
//   DIR/videoN/FOURCC-WxH/00000.bin ...   the frames, repeated; frame k shows k = sequence number
//                             modulo their count, also after losses
//   DIR/videoN/kind           capture (the default) | meta | output | m2m
//   DIR/videoN/log            appended to: OPEN, CLOSE, S_FMT, S_CTRL id value, STREAMON, STREAMOFF
//   DIR/videoN/fault          reread at each frame and call; any of these words:
//     stall           no more frames
//     drop=P          P % of the frames are lost, and their sequence numbers with them
//     errflag[=P]     P % of the frames (all) carry the error flag
//     eio             a fatal error: EIO until the stream is started anew
//     busy            EBUSY at S_FMT and REQBUFS, as if another program held the camera
//     eacces          EACCES at open
//     enospc          ENOSPC at STREAMON (no bandwidth left on the bus)
//     short=P         frames end after P % of their bytes
//     damage          an eighth of the bytes is missing in the middle; the end is as it should be
//     empty           frames of 0 bytes
//     grant=K         S_FMT grants mode K, whatever was asked
//     fps=R           frames come at R a second, whatever was granted
//     ahead=MS        stamps lie MS ahead
//     nostamp         stamps of an unknown clock, all 0
//     stuckseq        the sequence number is always 0
//     noparm          no frame rate can be set or asked
//     slowoff=MS      STREAMOFF takes MS
// A camera has one streaming user at a time, across processes, as a real one.
// What the program sees of /dev/video* and /dev/v4l is DIR/dev; a listing of /dev shows only that.
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <linux/videodev2.h>
#include <poll.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <time.h>
#include <unistd.h>

#define MAX_NODES 32
#define MAX_MODES 32
#define MAX_BUFFERS 8
#define REAL(type, name, ...)                                                                      \
  static type (*real_##name)(__VA_ARGS__);                                                         \
  if (!real_##name) real_##name = (type(*)(__VA_ARGS__))dlsym(RTLD_NEXT, #name)
#define FAIL(code)                                                                                 \
  do {                                                                                             \
    errno = (code);                                                                                \
    return -1;                                                                                     \
  } while (0)

struct mode {
  uint32_t fourcc, stride;
  int width, height, rates, rate[8], full;
};

struct node {
  int fd, held_fd, memory_fd;  // fd is an eventfd that is readable while frames are ready
  int number, blocking, owner;
  struct mode modes[MAX_MODES];
  int mode_count, current, rate, frame_count;
  uint32_t size, sequence, noise;
  int buffers, streaming, error;
  int queued[MAX_BUFFERS], queued_count, done[MAX_BUFFERS], done_count;
  struct v4l2_buffer buffer[MAX_BUFFERS];
  pthread_t producer;
};

static struct node *nodes[MAX_NODES];
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static char root[PATH_MAX];
static size_t root_length;

__attribute__((constructor)) static void start(void) {
  const char *folder = getenv("V4L2_SHIM_DIR");
  if (folder && realpath(folder, root)) root_length = strlen(root);
}

// --- small files -------------------------------------------------------------------------------

static int slurp(const char *path, void *into, size_t room) {
  REAL(int, open, const char *, int, ...);
  REAL(ssize_t, read, int, void *, size_t);
  REAL(int, close, int);
  int fd = real_open(path, O_RDONLY | O_CLOEXEC);
  if (fd < 0) return -1;
  size_t size = 0;
  ssize_t part;
  while (size < room && (part = real_read(fd, (char *)into + size, room - size)) > 0) size += part;
  real_close(fd);
  return (int)size;
}

static void text_of(int number, const char *leaf, char *into, int room) {
  char path[PATH_MAX + 64];
  snprintf(path, sizeof path, "%s/video%d/%s", root, number, leaf);
  int size = slurp(path, into, room - 1);
  into[size > 0 ? size : 0] = 0;
}

static void note(struct node *n, const char *format, ...) {
  REAL(int, open, const char *, int, ...);
  REAL(int, close, int);
  char path[PATH_MAX + 64], line[128];
  snprintf(path, sizeof path, "%s/video%d/log", root, n->number);
  int fd = real_open(path, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644);
  if (fd < 0) return;
  va_list values;
  va_start(values, format);
  int size = vsnprintf(line, sizeof line, format, values);
  va_end(values);
  if (write(fd, line, size) < 0) {
  }
  real_close(fd);
}

// The value of NAME=VALUE among the words, -1 if the word is absent, `bare` if it has no value.
static int word(const char *text, const char *name, int bare) {
  size_t size = strlen(name);
  for (const char *at = text; (at = strstr(at, name)); at += size) {
    if (at != text && at[-1] != ' ' && at[-1] != '\n') continue;
    if (at[size] == '=') return atoi(at + size + 1);
    if (at[size] == 0 || at[size] == ' ' || at[size] == '\n') return bare;
  }
  return -1;
}

static int chance(struct node *n, int percent) {
  n->noise = n->noise * 1664525u + 1013904223u;
  return (int)((n->noise >> 8) % 100) < percent;
}

// --- paths -------------------------------------------------------------------------------------

static int is_ours(const char *path) {
  return root_length && path &&
         (!strcmp(path, "/dev") || !strncmp(path, "/dev/video", 10) ||
          !strncmp(path, "/dev/v4l", 8));
}

static const char *mapped(const char *path, char *into) {
  if (!is_ours(path)) return path;
  snprintf(into, PATH_MAX, "%s%s", root, path);
  return into;
}

// The number of the node that a path leads to, or -1.
static int number_of(const char *path) {
  char inside[PATH_MAX], target[PATH_MAX];
  if (!is_ours(path) || !realpath(mapped(path, inside), target)) return -1;
  const char *name = target + root_length;
  return strncmp(name, "/dev/video", 10) || !name[10] ? -1 : atoi(name + 10);
}

#define STAT(name, type)                                                                           \
  int name(const char *path, struct type *s) {                                                     \
    char inside[PATH_MAX];                                                                         \
    REAL(int, name, const char *, struct type *);                                                  \
    int result = real_##name(mapped(path, inside), s);                                             \
    if (!result && is_ours(path) && S_ISREG(s->st_mode)) {                                         \
      s->st_mode = S_IFCHR | 0660;                                                                 \
      s->st_rdev = makedev(81, number_of(path));                                                   \
    }                                                                                              \
    return result;                                                                                 \
  }
STAT(stat, stat)
STAT(lstat, stat)
STAT(stat64, stat64)
STAT(lstat64, stat64)

int access(const char *path, int mode) {
  char inside[PATH_MAX];
  REAL(int, access, const char *, int);
  return real_access(mapped(path, inside), mode);
}

DIR *opendir(const char *path) {
  char inside[PATH_MAX];
  REAL(DIR *, opendir, const char *);
  return real_opendir(mapped(path, inside));
}

// Links that lead into DIR/dev, as those of /proc/PID/fd do, are shown as links into /dev.
ssize_t readlink(const char *path, char *into, size_t room) {
  char inside[PATH_MAX];
  REAL(ssize_t, readlink, const char *, char *, size_t);
  ssize_t size = real_readlink(mapped(path, inside), into, room);
  if (root_length && size > (ssize_t)root_length + 5 && !memcmp(into, root, root_length) &&
      !memcmp(into + root_length, "/dev/", 5)) {
    size -= root_length;
    memmove(into, into + root_length, size);
  }
  return size;
}

// --- the camera --------------------------------------------------------------------------------

static struct node *find(int fd) {
  for (int i = 0; i < MAX_NODES && fd > 0; i++)
    if (nodes[i] && nodes[i]->fd == fd) return nodes[i];
  return 0;
}

static int is_gone(struct node *n) {
  struct stat s;
  return fstat(n->held_fd, &s) || s.st_nlink == 0;
}

static void read_modes(struct node *n) {
  char text[8192], *next;
  text_of(n->number, "modes", text, sizeof text);
  for (char *line = strtok_r(text, "\n", &next); line; line = strtok_r(0, "\n", &next)) {
    struct mode *m = &n->modes[n->mode_count];
    char code[5], rates[128];
    if (n->mode_count == MAX_MODES ||
        sscanf(line, "%4s %d %d %127s", code, &m->width, &m->height, rates) < 4)
      continue;
    m->fourcc = v4l2_fourcc(code[0], code[1], code[2], code[3]);
    for (char *at = rates; *at && m->rates < 8; at += *at == ',')
      m->rate[m->rates++] = strtol(at, &at, 10);
    int stride = word(line, "stride", -1);
    m->stride = stride > 0 ? stride : 0;
    m->full = word(line, "full", 1) == 1;
    n->mode_count++;
  }
}

static int open_node(int number, int flags) {
  REAL(int, open, const char *, int, ...);
  REAL(int, close, int);
  char text[256], path[PATH_MAX + 64];
  text_of(number, "fault", text, sizeof text);
  if (word(text, "eacces", 1) > 0) FAIL(EACCES);
  struct node *n = calloc(1, sizeof *n);
  n->number = number;
  n->blocking = !(flags & O_NONBLOCK);
  n->noise = 12345;
  snprintf(path, sizeof path, "%s/dev/video%d", root, number);
  n->held_fd = real_open(path, O_RDWR | O_CLOEXEC);
  read_modes(n);
  if (n->held_fd < 0 || !n->mode_count) {
    if (n->held_fd >= 0) real_close(n->held_fd);
    free(n);
    FAIL(ENODEV);
  }
  n->rate = n->modes[0].rate[0];
  n->memory_fd = memfd_create("v4l2_shim", MFD_CLOEXEC);
  n->fd = eventfd(0, EFD_SEMAPHORE | EFD_CLOEXEC | EFD_NONBLOCK);
  pthread_mutex_lock(&lock);
  int place = 0;
  while (place < MAX_NODES && nodes[place]) place++;
  if (place < MAX_NODES) nodes[place] = n;
  pthread_mutex_unlock(&lock);
  if (place == MAX_NODES || n->fd < 0 || n->memory_fd < 0) abort();
  note(n, "OPEN\n");
  return n->fd;
}

static void fill_format(struct node *n, struct v4l2_pix_format *p) {
  struct mode *m = &n->modes[n->current];
  uint32_t w = m->width, h = m->height, line = 0, size;
  switch (m->fourcc) {
  case V4L2_PIX_FMT_MJPEG: size = w * h * 2; break;
  case V4L2_PIX_FMT_YUYV: case V4L2_PIX_FMT_UYVY: line = m->stride ?: 2 * w; size = line * h; break;
  case V4L2_PIX_FMT_NV12: case V4L2_PIX_FMT_YUV420: line = m->stride ?: w; size = line * h * 3 / 2; break;
  case V4L2_PIX_FMT_RGB24: case V4L2_PIX_FMT_BGR24: line = m->stride ?: 3 * w; size = line * h; break;
  default: line = m->stride ?: w; size = line * h;
  }
  memset(p, 0, sizeof *p);
  p->width = w, p->height = h, p->pixelformat = m->fourcc, p->field = V4L2_FIELD_NONE;
  p->bytesperline = line, p->sizeimage = size;
  p->colorspace = m->full || !line ? V4L2_COLORSPACE_JPEG : V4L2_COLORSPACE_SRGB;
}

// As drivers do: the nearest size of the format, or the default format if there is no such.
static int nearest_mode(struct node *n, const struct v4l2_pix_format *p) {
  int best = -1;
  long best_cost = 0;
  for (int i = 0; i < n->mode_count; i++) {
    struct mode *m = &n->modes[i];
    if (m->fourcc != p->pixelformat) continue;
    long cost = labs(m->width - (long)p->width) + labs(m->height - (long)p->height);
    if (best < 0 || cost < best_cost) best = i, best_cost = cost;
  }
  return best < 0 ? 0 : best;
}

static void frame_path(struct node *n, uint32_t index, char *into) {
  struct mode *m = &n->modes[n->current];
  snprintf(into, PATH_MAX + 64, "%s/video%d/%.4s-%dx%d/%05u.bin", root, n->number,
           (char *)&m->fourcc, m->width, m->height, index);
}

static void deliver(struct node *n, const char *fault) {
  REAL(void *, mmap, void *, size_t, int, int, int, off_t);
  char path[PATH_MAX + 64];
  pthread_mutex_lock(&lock);
  int index = -1;
  if (n->queued_count) {
    index = n->queued[0];
    memmove(n->queued, n->queued + 1, --n->queued_count * sizeof(int));
  }
  pthread_mutex_unlock(&lock);
  if (index < 0) return;  // no room: this frame is lost, and its sequence number tells
  frame_path(n, n->frame_count ? n->sequence % n->frame_count : 0, path);
  int prot = PROT_READ | PROT_WRITE;
  uint8_t *data = real_mmap(0, n->size, prot, MAP_SHARED, n->memory_fd, (off_t)index * n->size);
  int size = slurp(path, data, n->size), share = word(fault, "short", -1);
  if (size < 0) size = 0;
  if (word(fault, "damage", 1) > 0) {
    memmove(data + size / 2, data + size / 2 + size / 8, size - size / 2 - size / 8);
    size -= size / 8;
  }
  if (share >= 0) size = (int)((long)size * share / 100);
  if (word(fault, "empty", 1) > 0) size = 0;
  munmap(data, n->size);
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  int ahead = word(fault, "ahead", -1), errors = word(fault, "errflag", 100);
  int64_t us = now.tv_sec * 1000000LL + now.tv_nsec / 1000 + (ahead > 0 ? ahead * 1000LL : 0);
  uint32_t clock = V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
  if (word(fault, "nostamp", 1) > 0) us = 0, clock = 0;
  struct v4l2_buffer *b = &n->buffer[index];
  b->bytesused = size;
  b->sequence = word(fault, "stuckseq", 1) > 0 ? 0 : n->sequence;
  b->timestamp.tv_sec = us / 1000000, b->timestamp.tv_usec = us % 1000000;
  b->field = V4L2_FIELD_NONE;
  b->flags = V4L2_BUF_FLAG_MAPPED | V4L2_BUF_FLAG_DONE | clock |
             (errors > 0 && chance(n, errors) ? V4L2_BUF_FLAG_ERROR : 0);
  pthread_mutex_lock(&lock);
  n->done[n->done_count++] = index;
  pthread_mutex_unlock(&lock);
  eventfd_write(n->fd, 1);
}

static void *produce(void *argument) {
  struct node *n = argument;
  struct timespec due;
  clock_gettime(CLOCK_MONOTONIC, &due);
  for (n->sequence = 0; n->streaming; n->sequence++) {
    char fault[256];
    text_of(n->number, "fault", fault, sizeof fault);
    int rate = word(fault, "fps", -1);
    due.tv_nsec += 1000000000L / (rate > 0 ? rate : n->rate ?: 30);
    for (; due.tv_nsec >= 1000000000L; due.tv_nsec -= 1000000000L) due.tv_sec++;
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, 0) == EINTR) {
    }
    text_of(n->number, "fault", fault, sizeof fault);
    if (!n->streaming) break;
    if (word(fault, "eio", 1) > 0) n->error = EIO;
    if (is_gone(n)) n->error = ENODEV;
    if (n->error) {
      eventfd_write(n->fd, 1);  // wakes who waits
      break;
    }
    if (word(fault, "stall", 1) > 0) {
      n->sequence--;
      continue;
    }
    int lost = word(fault, "drop", -1);
    if (lost < 0 || !chance(n, lost)) deliver(n, fault);
  }
  return 0;
}

static void stream(struct node *n, int on) {
  if (on == n->streaming) return;
  n->streaming = on;
  if (on) {
    char path[PATH_MAX + 64];
    REAL(int, access, const char *, int);
    for (n->frame_count = 0; frame_path(n, n->frame_count, path), !real_access(path, R_OK);)
      n->frame_count++;
    n->error = 0;
    pthread_create(&n->producer, 0, produce, n);
    return;
  }
  eventfd_t ignored;
  pthread_join(n->producer, 0);
  n->done_count = n->queued_count = 0;
  while (!eventfd_read(n->fd, &ignored)) {
  }
}

static int take_ownership(struct node *n, const char *fault, int keep) {
  if (word(fault, "busy", 1) > 0) FAIL(EBUSY);
  if (n->owner) return 0;
  if (flock(n->held_fd, LOCK_EX | LOCK_NB)) FAIL(EBUSY);
  if (keep) n->owner = 1;
  else flock(n->held_fd, LOCK_UN);
  return 0;
}

static void drop_ownership(struct node *n) {
  if (n->owner) flock(n->held_fd, LOCK_UN);
  n->owner = 0;
}

// --- controls ----------------------------------------------------------------------------------

static struct control {
  uint32_t id, type;
  const char *name;
  int low, high, step, initial, value;
  const char *items[4];
  uint32_t switched_by;
  int switched_on_at;
} controls[] = {
  {0x00980900, V4L2_CTRL_TYPE_INTEGER, "Brightness", -64, 64, 1, 0, 0, {0}, 0, 0},
  {0x0098090c, V4L2_CTRL_TYPE_BOOLEAN, "White Balance, Automatic", 0, 1, 1, 1, 1, {0}, 0, 0},
  {0x00980913, V4L2_CTRL_TYPE_INTEGER, "Gain", 0, 100, 1, 0, 0, {0}, 0, 0},
  {0x00980918, V4L2_CTRL_TYPE_MENU, "Power Line Frequency", 0, 2, 1, 1, 1,
   {"Disabled", "50 Hz", "60 Hz", 0}, 0, 0},
  {0x009a0901, V4L2_CTRL_TYPE_MENU, "Auto Exposure", 0, 3, 1, 3, 3,
   {0, "Manual Mode", 0, "Aperture Priority Mode"}, 0, 0},
  {0x009a0902, V4L2_CTRL_TYPE_INTEGER, "Exposure Time, Absolute", 3, 2047, 1, 250, 250, {0},
   0x009a0901, 1},
  {0x009a090a, V4L2_CTRL_TYPE_INTEGER, "Focus, Absolute", 0, 250, 5, 0, 0, {0}, 0x009a090c, 0},
  {0x009a090c, V4L2_CTRL_TYPE_BOOLEAN, "Focus, Automatic Continuous", 0, 1, 1, 1, 1, {0}, 0, 0},
};
#define CONTROLS (int)(sizeof controls / sizeof *controls)

static struct control *control_of(uint32_t id) {
  int next = (id & V4L2_CTRL_FLAG_NEXT_CTRL) != 0;
  id &= 0x0fffffff;
  for (int i = 0; i < CONTROLS; i++)
    if (next ? controls[i].id > id : controls[i].id == id) return &controls[i];
  return 0;
}

static int is_inactive(const struct control *c) {
  struct control *by = c->switched_by ? control_of(c->switched_by) : 0;
  return by && by->value != c->switched_on_at;
}

static int control_call(struct node *n, uint32_t request, void *argument) {
  struct control *c = control_of(*(uint32_t *)argument);  // the id comes first in all of them
  if (!c) FAIL(EINVAL);
  if (request == VIDIOC_QUERYCTRL) {
    struct v4l2_queryctrl *q = argument;
    memset(q, 0, sizeof *q);
    q->id = c->id, q->type = c->type;
    snprintf((char *)q->name, sizeof q->name, "%s", c->name);
    q->minimum = c->low, q->maximum = c->high, q->step = c->step, q->default_value = c->initial;
    q->flags = is_inactive(c) ? V4L2_CTRL_FLAG_INACTIVE : 0;
    return 0;
  }
  if (request == VIDIOC_QUERYMENU) {
    struct v4l2_querymenu *q = argument;
    if (c->type != V4L2_CTRL_TYPE_MENU || q->index > 3 || !c->items[q->index]) FAIL(EINVAL);
    snprintf((char *)q->name, sizeof q->name, "%s", c->items[q->index]);
    return 0;
  }
  struct v4l2_control *v = argument;
  if (request == VIDIOC_S_CTRL) {
    if (is_inactive(c)) FAIL(EACCES);
    if (v->value < c->low || v->value > c->high) FAIL(ERANGE);
    c->value = v->value - (v->value - c->low) % c->step;
    note(n, "S_CTRL %08x %d\n", c->id, c->value);
  }
  v->value = c->value;
  return 0;
}

// --- ioctl -------------------------------------------------------------------------------------

static int query_capabilities(struct node *n, struct v4l2_capability *c) {
  char kind[16];
  text_of(n->number, "kind", kind, sizeof kind);
  memset(c, 0, sizeof *c);
  strcpy((char *)c->driver, "v4l2_shim");
  snprintf((char *)c->card, sizeof c->card, "Emulated Camera %d", n->number & ~1);
  snprintf((char *)c->bus_info, sizeof c->bus_info, "usb-shim-%d", n->number & ~1);
  c->version = 0x60100;
  c->device_caps = !strncmp(kind, "meta", 4)     ? V4L2_CAP_META_CAPTURE
                   : !strncmp(kind, "output", 6) ? V4L2_CAP_VIDEO_OUTPUT
                   : !strncmp(kind, "m2m", 3)    ? V4L2_CAP_VIDEO_M2M
                                                 : V4L2_CAP_VIDEO_CAPTURE;
  c->device_caps |= V4L2_CAP_STREAMING | V4L2_CAP_EXT_PIX_FORMAT;
  // The whole device captures, whatever this node does: as the two nodes of a UVC camera say.
  c->capabilities = c->device_caps | V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_DEVICE_CAPS;
  return 0;
}

static int enumerate_format(struct node *n, struct v4l2_fmtdesc *d) {
  uint32_t seen[MAX_MODES], count = 0;
  for (int i = 0; i < n->mode_count; i++) {
    uint32_t j = 0;
    while (j < count && seen[j] != n->modes[i].fourcc) j++;
    if (j == count) seen[count++] = n->modes[i].fourcc;
  }
  if (d->type != V4L2_BUF_TYPE_VIDEO_CAPTURE || d->index >= count) FAIL(EINVAL);
  d->pixelformat = seen[d->index];
  d->flags = d->pixelformat == V4L2_PIX_FMT_MJPEG ? V4L2_FMT_FLAG_COMPRESSED : 0;
  snprintf((char *)d->description, sizeof d->description, "%.4s", (char *)&d->pixelformat);
  return 0;
}

static int enumerate_size(struct node *n, struct v4l2_frmsizeenum *s) {
  uint32_t count = 0;
  for (int i = 0; i < n->mode_count; i++)
    if (n->modes[i].fourcc == s->pixel_format && count++ == s->index) {
      s->type = V4L2_FRMSIZE_TYPE_DISCRETE;
      s->discrete.width = n->modes[i].width, s->discrete.height = n->modes[i].height;
      return 0;
    }
  FAIL(EINVAL);
}

static int enumerate_interval(struct node *n, struct v4l2_frmivalenum *s) {
  for (int i = 0; i < n->mode_count; i++) {
    struct mode *m = &n->modes[i];
    if (m->fourcc != s->pixel_format || m->width != (int)s->width || m->height != (int)s->height)
      continue;
    if ((int)s->index >= m->rates) FAIL(EINVAL);
    s->type = V4L2_FRMIVAL_TYPE_DISCRETE;
    s->discrete.numerator = 1, s->discrete.denominator = m->rate[s->index];
    return 0;
  }
  FAIL(EINVAL);
}

static int set_format(struct node *n, uint32_t request, struct v4l2_format *f, const char *fault) {
  if (f->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) FAIL(EINVAL);
  int before = n->current, granted = word(fault, "grant", -1);
  if (request == VIDIOC_S_FMT && (n->buffers || take_ownership(n, fault, 0))) FAIL(EBUSY);
  if (request != VIDIOC_G_FMT) n->current = nearest_mode(n, &f->fmt.pix);
  if (request != VIDIOC_G_FMT && granted >= 0 && granted < n->mode_count) n->current = granted;
  fill_format(n, &f->fmt.pix);
  if (request == VIDIOC_TRY_FMT) n->current = before;
  if (request != VIDIOC_S_FMT) return 0;
  n->rate = n->modes[n->current].rate[0];
  note(n, "S_FMT %.4s %dx%d\n", (char *)&f->fmt.pix.pixelformat, f->fmt.pix.width,
       f->fmt.pix.height);
  return 0;
}

static int set_rate(struct node *n, uint32_t request, struct v4l2_streamparm *p) {
  struct v4l2_fract *t = &p->parm.capture.timeperframe;
  struct mode *m = &n->modes[n->current];
  if (p->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) FAIL(EINVAL);
  if (request == VIDIOC_S_PARM && t->numerator) {
    int asked = (int)((t->denominator + t->numerator / 2) / t->numerator), best = m->rate[0];
    for (int i = 0; i < m->rates; i++)
      if (abs(m->rate[i] - asked) < abs(best - asked)) best = m->rate[i];
    n->rate = best;
  }
  memset(&p->parm, 0, sizeof p->parm);
  p->parm.capture.capability = V4L2_CAP_TIMEPERFRAME;
  t->numerator = 1, t->denominator = n->rate;
  p->parm.capture.readbuffers = 2;
  return 0;
}

static int request_buffers(struct node *n, struct v4l2_requestbuffers *q, const char *fault) {
  if (q->type != V4L2_BUF_TYPE_VIDEO_CAPTURE || q->memory != V4L2_MEMORY_MMAP) FAIL(EINVAL);
  struct v4l2_pix_format p;
  fill_format(n, &p);
  n->size = (p.sizeimage + 4095) & ~4095u;
  if (q->count > MAX_BUFFERS) q->count = MAX_BUFFERS;
  if (q->count) {
    if (take_ownership(n, fault, 1)) return -1;
    if (ftruncate(n->memory_fd, (off_t)n->size * q->count)) FAIL(ENOMEM);
  } else {
    stream(n, 0);
    drop_ownership(n);
  }
  n->buffers = q->count, n->queued_count = 0;
  return 0;
}

static int query_buffer(struct node *n, uint32_t request, struct v4l2_buffer *b) {
  uint32_t index = b->index;
  if ((int)index >= n->buffers) FAIL(EINVAL);
  struct v4l2_buffer *own = &n->buffer[index];
  if (request == VIDIOC_QUERYBUF) {
    memset(own, 0, sizeof *own);
    own->index = index, own->type = V4L2_BUF_TYPE_VIDEO_CAPTURE, own->memory = V4L2_MEMORY_MMAP;
    own->length = n->size, own->m.offset = index * n->size;
    own->flags = V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    *b = *own;
    return 0;
  }
  pthread_mutex_lock(&lock);
  n->queued[n->queued_count++] = index;
  pthread_mutex_unlock(&lock);
  return 0;
}

static int dequeue(struct node *n, struct v4l2_buffer *b) {
  REAL(int, poll, struct pollfd *, nfds_t, int);
  if (!n->streaming) FAIL(EINVAL);
  for (;;) {
    if (n->error) FAIL(n->error);
    pthread_mutex_lock(&lock);
    int index = -1;
    if (n->done_count) {
      index = n->done[0];
      memmove(n->done, n->done + 1, --n->done_count * sizeof(int));
    }
    pthread_mutex_unlock(&lock);
    if (index >= 0) {
      eventfd_t one;
      eventfd_read(n->fd, &one);
      *b = n->buffer[index];
      return 0;
    }
    if (!n->blocking) FAIL(EAGAIN);
    struct pollfd wait = {n->fd, POLLIN, 0};
    real_poll(&wait, 1, -1);
  }
}

static int call(struct node *n, unsigned long request, void *argument) {
  char fault[256];
  text_of(n->number, "fault", fault, sizeof fault);
  if (is_gone(n)) FAIL(ENODEV);
  switch ((uint32_t)request) {
  case VIDIOC_QUERYCAP: return query_capabilities(n, argument);
  case VIDIOC_ENUM_FMT: return enumerate_format(n, argument);
  case VIDIOC_ENUM_FRAMESIZES: return enumerate_size(n, argument);
  case VIDIOC_ENUM_FRAMEINTERVALS: return enumerate_interval(n, argument);
  case VIDIOC_G_FMT: case VIDIOC_TRY_FMT: case VIDIOC_S_FMT:
    return set_format(n, request, argument, fault);
  case VIDIOC_G_PARM: case VIDIOC_S_PARM:
    if (word(fault, "noparm", 1) > 0) FAIL(ENOTTY);
    return set_rate(n, request, argument);
  case VIDIOC_QUERYCTRL: case VIDIOC_QUERYMENU: case VIDIOC_G_CTRL: case VIDIOC_S_CTRL:
    return control_call(n, request, argument);
  case VIDIOC_ENUMINPUT: {
    struct v4l2_input *i = argument;
    if (i->index) FAIL(EINVAL);
    memset(i, 0, sizeof *i);
    strcpy((char *)i->name, "Camera 1");
    i->type = V4L2_INPUT_TYPE_CAMERA;
    return 0;
  }
  case VIDIOC_G_INPUT: *(int *)argument = 0; return 0;
  case VIDIOC_S_INPUT: if (*(int *)argument) FAIL(EINVAL); return 0;
  case VIDIOC_REQBUFS: return request_buffers(n, argument, fault);
  case VIDIOC_QUERYBUF: case VIDIOC_QBUF: return query_buffer(n, request, argument);
  case VIDIOC_DQBUF: return dequeue(n, argument);
  case VIDIOC_STREAMON:
    if (word(fault, "enospc", 1) > 0) FAIL(ENOSPC);
    note(n, "STREAMON\n");
    stream(n, 1);
    return 0;
  case VIDIOC_STREAMOFF: {
    int ms = word(fault, "slowoff", -1);
    if (ms > 0) usleep(ms * 1000u);
    note(n, "STREAMOFF\n");
    stream(n, 0);
    return 0;
  }
  default: FAIL(ENOTTY);
  }
}

int ioctl(int fd, unsigned long request, ...) {
  va_list values;
  va_start(values, request);
  void *argument = va_arg(values, void *);
  va_end(values);
  struct node *n = find(fd);
  if (n) return call(n, request, argument);
  REAL(int, ioctl, int, unsigned long, ...);
  return real_ioctl(fd, request, argument);
}

// --- the rest of the calls ---------------------------------------------------------------------

#define MODE_OF(flags, last)                                                                       \
  mode_t mode = 0;                                                                                 \
  if ((flags) & (O_CREAT | __O_TMPFILE)) {                                                         \
    va_list values;                                                                                \
    va_start(values, last);                                                                        \
    mode = va_arg(values, mode_t);                                                                 \
    va_end(values);                                                                                \
  }
#define OPEN(name)                                                                                 \
  int name(const char *path, int flags, ...) {                                                     \
    char inside[PATH_MAX];                                                                         \
    MODE_OF(flags, flags)                                                                          \
    int number = number_of(path);                                                                  \
    if (number >= 0) return open_node(number, flags);                                              \
    REAL(int, name, const char *, int, ...);                                                       \
    return real_##name(mapped(path, inside), flags, mode);                                         \
  }
#define OPENAT(name)                                                                               \
  int name(int folder, const char *path, int flags, ...) {                                         \
    char inside[PATH_MAX];                                                                         \
    MODE_OF(flags, flags)                                                                          \
    int number = number_of(path);                                                                  \
    if (number >= 0) return open_node(number, flags);                                              \
    REAL(int, name, int, const char *, int, ...);                                                  \
    return real_##name(folder, mapped(path, inside), flags, mode);                                 \
  }
OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)

#define MMAP(name)                                                                                 \
  void *name(void *at, size_t size, int prot, int flags, int fd, off_t offset) {                   \
    struct node *n = find(fd);                                                                     \
    REAL(void *, name, void *, size_t, int, int, int, off_t);                                      \
    return real_##name(at, size, prot, flags, n ? n->memory_fd : fd, offset);                      \
  }
MMAP(mmap)
MMAP(mmap64)

// A device that is gone, broken or not streaming says so in poll, as videobuf2 does.
int poll(struct pollfd *fds, nfds_t count, int timeout) {
  REAL(int, poll, struct pollfd *, nfds_t, int);
  for (nfds_t i = 0; i < count; i++) {
    struct node *n = find(fds[i].fd);
    if (n && (!n->streaming || n->error)) timeout = 0;
  }
  int ready = real_poll(fds, count, timeout);
  for (nfds_t i = 0; i < count && ready >= 0; i++) {
    struct node *n = find(fds[i].fd);
    if (!n || (n->streaming && !n->error)) continue;
    if (!fds[i].revents) ready++;
    fds[i].revents |= POLLERR | (n->error == ENODEV ? POLLHUP : 0);
  }
  return ready;
}

int close(int fd) {
  REAL(int, close, int);
  struct node *n = find(fd);
  if (!n) return real_close(fd);
  stream(n, 0);
  note(n, "CLOSE\n");
  pthread_mutex_lock(&lock);
  for (int i = 0; i < MAX_NODES; i++)
    if (nodes[i] == n) nodes[i] = 0;
  pthread_mutex_unlock(&lock);
  drop_ownership(n);
  real_close(n->held_fd);
  real_close(n->memory_fd);
  free(n);
  return real_close(fd);
}
