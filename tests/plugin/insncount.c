/* QEMU TCG plugin (API version 1) that counts executed instructions of a Thumb-2 program, by function.
 *
 *   cc -O2 -shared -fPIC -o insncount.so insncount.c
 *   qemu-system-arm ... -plugin file=insncount.so,out=FILE,runs=FILE,region=NAME:0xADDR,exclude=0xADDR:0xSIZE
 *
 * A region is a function. One run of it is what executes from a call to it until the instruction after that call, with
 * all that it calls: the call counts, the instruction after it does not. `region` and `exclude` may be repeated.
 * Instructions within an excluded range count nowhere: with the interrupt handlers excluded, counts do not depend on when
 * a byte arrives.
 *
 * out   a line a region: `region NAME runs N min N max N mean X entries N unfinished N`, then `total N`. Entries are those
 *       without a call just before, which is how a tail call looks: they are not counted as runs, so the figures of a
 *       region that has any are incomplete. Unfinished runs did not return.
 * runs  a line a run, in the order in which they ended: `NAME N`.
 *
 * QEMU's packages ship no qemu-plugin.h: the declarations are those of its version 7.2.
 */
#include <inttypes.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef uint64_t qemu_plugin_id_t;
typedef struct qemu_info_t qemu_info_t;
struct qemu_plugin_tb;
struct qemu_plugin_insn;
enum qemu_plugin_cb_flags { QEMU_PLUGIN_CB_NO_REGS, QEMU_PLUGIN_CB_R_REGS, QEMU_PLUGIN_CB_RW_REGS };
enum qemu_plugin_op { QEMU_PLUGIN_INLINE_ADD_U64 };
void qemu_plugin_register_vcpu_tb_trans_cb(qemu_plugin_id_t, void (*)(qemu_plugin_id_t, struct qemu_plugin_tb *));
void qemu_plugin_register_atexit_cb(qemu_plugin_id_t, void (*)(qemu_plugin_id_t, void *), void *);
size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb *);
struct qemu_plugin_insn *qemu_plugin_tb_get_insn(const struct qemu_plugin_tb *, size_t);
uint64_t qemu_plugin_insn_vaddr(const struct qemu_plugin_insn *);
size_t qemu_plugin_insn_size(const struct qemu_plugin_insn *);
const void *qemu_plugin_insn_data(const struct qemu_plugin_insn *);
const void *qemu_plugin_insn_haddr(const struct qemu_plugin_insn *);
void qemu_plugin_register_vcpu_insn_exec_inline(struct qemu_plugin_insn *, enum qemu_plugin_op, void *, uint64_t);
void qemu_plugin_register_vcpu_insn_exec_cb(struct qemu_plugin_insn *, void (*)(unsigned int, void *),
                                            enum qemu_plugin_cb_flags, void *);

#define EXPORT __attribute__((visibility("default")))
EXPORT int qemu_plugin_version = 1;

#define REGIONS 16
#define RANGES 16

struct region {
    char name[64];
    uint32_t address;
    bool open;          /* within a run; calls from there to the same function are part of it */
    uint32_t return_to; /* the instruction after the call */
    uint64_t start;
    uint64_t runs, sum, min, max;
    uint64_t entries; /* without a call */
};

struct range {
    uint32_t address, size;
};

static struct region regions[REGIONS];
static size_t n_regions;
static struct range excluded[RANGES];
static size_t n_excluded;
static uint64_t total;
static FILE *out, *runs;

/* The last call, to a region or through a register. */
static struct {
    uint32_t return_to;
    uint64_t at;
} call = {0, UINT64_MAX};

/* ---- execution ---- */

static void on_call(unsigned int cpu, void *return_to)
{
    (void)cpu;
    call.return_to = (uint32_t)(uintptr_t)return_to;
    call.at = total;
}

/* The first instruction of a region. It is called if the instruction counted just before is a call. */
static void on_entry(unsigned int cpu, void *data)
{
    struct region *r = data;
    (void)cpu;
    if (r->open)
        return;
    if (total != call.at + 1) {
        r->entries++;
        return;
    }
    r->open = true;
    r->return_to = call.return_to;
    r->start = call.at;
}

static void end_run(struct region *r)
{
    uint64_t count = total - r->start; /* both totals hold their own instruction: the call counts, this one does not */
    r->open = false;
    r->min = r->runs && r->min < count ? r->min : count;
    r->max = r->max > count ? r->max : count;
    r->sum += count;
    r->runs++;
    if (runs)
        fprintf(runs, "%s %" PRIu64 "\n", r->name, count);
}

static void on_return(unsigned int cpu, void *address)
{
    (void)cpu;
    for (size_t i = 0; i < n_regions; i++)
        if (regions[i].open && regions[i].return_to == (uint32_t)(uintptr_t)address)
            end_run(&regions[i]);
}

/* ---- translation ---- */

/* BL, encoding T1 (ARMv7-M Architecture Reference Manual, A7.7.18). */
static bool is_bl(const uint16_t h[2])
{
    return (h[0] & 0xF800) == 0xF000 && (h[1] & 0xD000) == 0xD000;
}

static uint32_t bl_target(uint32_t address, const uint16_t h[2])
{
    uint32_t s = h[0] >> 10 & 1;
    uint32_t i1 = ~((h[1] >> 13 & 1) ^ s) & 1;
    uint32_t i2 = ~((h[1] >> 11 & 1) ^ s) & 1;
    uint32_t offset = i1 << 23 | i2 << 22 | (h[0] & 0x3FFu) << 12 | (h[1] & 0x7FFu) << 1;
    return address + 4 + offset - (s << 24);
}

/* BLX through a register, encoding T1 (A7.7.19). Where to, is known only when it executes. */
static bool is_blx(uint16_t h)
{
    return (h & 0xFF87) == 0x4780;
}

static struct region *region_at(uint32_t address)
{
    for (size_t i = 0; i < n_regions; i++)
        if (regions[i].address == address)
            return &regions[i];
    return NULL;
}

static bool is_call(uint32_t address, const void *code, size_t size)
{
    uint16_t h[2] = {0, 0};
    memcpy(h, code, size);
    return size == 4 ? is_bl(h) && region_at(bl_target(address, h)) : is_blx(h[0]);
}

/* Whether what lies before an instruction in memory is a call. */
static bool follows_call(uint32_t address, const char *code)
{
    return code && address >= 4 && (is_call(address - 4, code - 4, 4) || is_call(address - 2, code - 2, 2));
}

static bool is_excluded(uint32_t address)
{
    for (size_t i = 0; i < n_excluded; i++)
        if (address - excluded[i].address < excluded[i].size)
            return true;
    return false;
}

static void watch(struct qemu_plugin_insn *insn, void (*callback)(unsigned int, void *), void *data)
{
    qemu_plugin_register_vcpu_insn_exec_cb(insn, callback, QEMU_PLUGIN_CB_NO_REGS, data);
}

static void translate(struct qemu_plugin_insn *insn, bool first)
{
    uint32_t address = (uint32_t)qemu_plugin_insn_vaddr(insn);
    size_t size = qemu_plugin_insn_size(insn);
    struct region *region = region_at(address);
    if (is_excluded(address))
        return;
    qemu_plugin_register_vcpu_insn_exec_inline(insn, QEMU_PLUGIN_INLINE_ADD_U64, &total, 1);
    if (first && follows_call(address, qemu_plugin_insn_haddr(insn)))
        watch(insn, on_return, (void *)(uintptr_t)address);
    if (region)
        watch(insn, on_entry, region);
    if (is_call(address, qemu_plugin_insn_data(insn), size))
        watch(insn, on_call, (void *)(uintptr_t)(address + size));
}

/* A call ends a block of translation, so the instruction after it is the first of another. */
static void on_translation(qemu_plugin_id_t id, struct qemu_plugin_tb *block)
{
    (void)id;
    for (size_t i = 0; i < qemu_plugin_tb_n_insns(block); i++)
        translate(qemu_plugin_tb_get_insn(block, i), i == 0);
}

/* ---- arguments and report ---- */

static void report(qemu_plugin_id_t id, void *data)
{
    (void)id, (void)data;
    for (struct region *r = regions; r < regions + n_regions; r++)
        fprintf(out,
                "region %s runs %" PRIu64 " min %" PRIu64 " max %" PRIu64 " mean %.3f entries %" PRIu64 " unfinished %d\n",
                r->name, r->runs, r->min, r->max, r->runs ? (double)r->sum / (double)r->runs : 0.0, r->entries, r->open);
    fprintf(out, "total %" PRIu64 "\n", total);
    fclose(out);
    if (runs)
        fclose(runs);
}

static bool add_region(const char *value)
{
    struct region *r = &regions[n_regions];
    if (n_regions == REGIONS || sscanf(value, "%63[^:]:%" SCNx32, r->name, &r->address) != 2)
        return false;
    r->address &= ~UINT32_C(1); /* a symbol's lowest bit says Thumb */
    n_regions++;
    return true;
}

static bool add_range(const char *value)
{
    struct range *r = &excluded[n_excluded];
    if (n_excluded == RANGES || sscanf(value, "%" SCNx32 ":%" SCNx32, &r->address, &r->size) != 2)
        return false;
    r->address &= ~UINT32_C(1);
    n_excluded++;
    return true;
}

static bool take(const char *argument)
{
    if (!strncmp(argument, "out=", 4))
        return (out = fopen(argument + 4, "w")) != NULL;
    if (!strncmp(argument, "runs=", 5))
        return (runs = fopen(argument + 5, "w")) != NULL;
    if (!strncmp(argument, "region=", 7))
        return add_region(argument + 7);
    if (!strncmp(argument, "exclude=", 8))
        return add_range(argument + 8);
    return false;
}

EXPORT int qemu_plugin_install(qemu_plugin_id_t id, const qemu_info_t *info, int argc, char **argv)
{
    (void)info;
    for (int i = 0; i < argc; i++)
        if (!take(argv[i])) {
            fprintf(stderr, "insncount: cannot use %s\n", argv[i]);
            return -1;
        }
    out = out ? out : stderr;
    qemu_plugin_register_vcpu_tb_trans_cb(id, on_translation);
    qemu_plugin_register_atexit_cb(id, report, NULL);
    return 0;
}
