// Hidraw nodes for a machine without any, by LD_PRELOAD: an emulator, see rig/devices/hid/shim.py.
//
// A file NAME.hidraw that is a Unix socket (SOCK_SEQPACKET, one report a packet) opens as a hidraw
// node. Its report descriptor and what the kernel would tell of it lie in NAME.hidraw.sys/device/,
// in the files the kernel has there. FAKE_HIDRAW: the folder whose nodes libudev lists.
//
// When the socket's other end is gone, poll tells POLLHUP, as of a node that was unplugged.
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/hidraw.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define SUFFIX ".hidraw"
#define NODES 64
#define LONGEST 512

static char *paths[NODES];  // By file descriptor; a node with a higher one is refused.

static int is_node(const char *path) {
    size_t n = path ? strlen(path) : 0, m = strlen(SUFFIX);
    struct stat found;
    return n > m && !strcmp(path + n - m, SUFFIX) && !stat(path, &found) && S_ISSOCK(found.st_mode);
}
static long content(const char *node, const char *file, char *into, long size) {
    char path[LONGEST];
    snprintf(path, sizeof path, "%s.sys/device/%s", node, file);
    FILE *stream = fopen(path, "rb");
    if (!stream) return -1;
    long n = fread(into, 1, size - 1, stream);
    fclose(stream);
    into[n] = 0;
    return n;
}
static int open_node(const char *path) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    int fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    if (fd < 0) return -1;
    strncpy(address.sun_path, path, sizeof address.sun_path - 1);
    if (fd >= NODES || connect(fd, (struct sockaddr *)&address, sizeof address)) {
        close(fd);
        errno = ENODEV;
        return -1;
    }
    paths[fd] = strdup(path);
    return fd;
}

int open(const char *path, int flags, ...) {
    va_list a; va_start(a, flags); mode_t mode = va_arg(a, int); va_end(a);
    return is_node(path) ? open_node(path) : REAL(open)(path, flags, mode);
}
int open64(const char *path, int flags, ...) {
    va_list a; va_start(a, flags); mode_t mode = va_arg(a, int); va_end(a);
    return is_node(path) ? open_node(path) : REAL(open64)(path, flags, mode);
}
int close(int fd) {
    if (fd >= 0 && fd < NODES && paths[fd]) { free(paths[fd]); paths[fd] = 0; }
    return REAL(close)(fd);
}
int ioctl(int fd, unsigned long code, ...) {
    va_list a; va_start(a, code); void *arg = va_arg(a, void *); va_end(a);
    const char *node = fd >= 0 && fd < NODES ? paths[fd] : 0;
    if (!node) return ((int (*)(int, unsigned long, ...))dlsym(RTLD_NEXT, "ioctl"))(fd, code, arg);
    char text[HID_MAX_DESCRIPTOR_SIZE + 1];
    if (code == HIDIOCGRDESCSIZE || code == HIDIOCGRDESC) {
        long n = content(node, "report_descriptor", text, sizeof text);
        if (n < 0) { errno = ENODEV; return -1; }
        if (code == HIDIOCGRDESCSIZE) { *(int *)arg = n; return 0; }
        struct hidraw_report_descriptor *found = arg;
        if (found->size > n) found->size = n;
        memcpy(found->value, text, found->size);
        return 0;
    }
    if (code == HIDIOCGRAWINFO) {
        unsigned bus = 0, vendor = 0, product = 0;
        if (content(node, "uevent", text, sizeof text) < 0 || !strstr(text, "HID_ID=")) {
            errno = ENODEV; return -1;
        }
        sscanf(strstr(text, "HID_ID="), "HID_ID=%x:%x:%x", &bus, &vendor, &product);
        struct hidraw_devinfo *info = arg;
        info->bustype = bus; info->vendor = vendor; info->product = product;
        return 0;
    }
    errno = ENOTTY;
    return -1;
}

// What hidapi asks of libudev. An entry of the list is a node's .sys folder; one device stands for
// the node and for its parent of subsystem hid; there are no USB parents, as of a virtual device.
struct udev { int unused; };
struct udev_list_entry { char name[LONGEST]; struct udev_list_entry *next; };
struct udev_enumerate { struct udev_list_entry *first; };
struct udev_device { char sys[LONGEST], node[LONGEST], value[4096]; };

struct udev *udev_new(void) { return calloc(1, sizeof(struct udev)); }
struct udev *udev_unref(struct udev *u) { free(u); return 0; }
struct udev_enumerate *udev_enumerate_new(struct udev *u) {
    return calloc(1, sizeof(struct udev_enumerate));
}
int udev_enumerate_add_match_subsystem(struct udev_enumerate *e, const char *name) { return 0; }
int udev_enumerate_scan_devices(struct udev_enumerate *e) {
    const char *folder = getenv("FAKE_HIDRAW");
    DIR *listing = folder ? opendir(folder) : 0;
    for (struct dirent *d; listing && (d = readdir(listing));) {
        char node[LONGEST];
        snprintf(node, sizeof node, "%s/%s", folder, d->d_name);
        if (!is_node(node)) continue;
        struct udev_list_entry *entry = calloc(1, sizeof *entry);
        snprintf(entry->name, LONGEST, "%s.sys", node);
        entry->next = e->first; e->first = entry;
    }
    if (listing) closedir(listing);
    return 0;
}
struct udev_list_entry *udev_enumerate_get_list_entry(struct udev_enumerate *e) {
    return e->first;
}
struct udev_list_entry *udev_list_entry_get_next(struct udev_list_entry *l) { return l->next; }
const char *udev_list_entry_get_name(struct udev_list_entry *l) { return l->name; }
struct udev_enumerate *udev_enumerate_unref(struct udev_enumerate *e) {
    for (struct udev_list_entry *l = e->first, *next; l; l = next) { next = l->next; free(l); }
    free(e);
    return 0;
}
struct udev_device *udev_device_new_from_syspath(struct udev *u, const char *path) {
    struct udev_device *d = calloc(1, sizeof *d);
    snprintf(d->sys, LONGEST, "%s", path);
    snprintf(d->node, LONGEST, "%.*s", (int)(strlen(path) - strlen(".sys")), path);
    return d;
}
struct udev_device *udev_device_new_from_devnum(struct udev *u, char type, dev_t number) {
    return 0;
}
struct udev_device *udev_device_unref(struct udev_device *d) { free(d); return 0; }
const char *udev_device_get_devnode(struct udev_device *d) { return d->node; }
const char *udev_device_get_syspath(struct udev_device *d) { return d->sys; }
struct udev_device *udev_device_get_parent_with_subsystem_devtype(
    struct udev_device *d, const char *subsystem, const char *type) {
    return strcmp(subsystem, "hid") ? 0 : d;
}
const char *udev_device_get_sysattr_value(struct udev_device *d, const char *name) {
    return content(d->node, name, d->value, sizeof d->value) < 0 ? 0 : d->value;
}
