/* The time loops of kros: what steps sample by sample, compiled at first use (kros.loops.library). Machines lie side by side in vectors;
   every operation on a machine has the order of the NumPy code that stands for it where there is no compiler.

   A job is a struct of 64-bit numbers and pointers, in the order in which kros.loops reads it from this file. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined __AVX512F__ /* machines in a vector of the processor: compilers handle larger ones badly */
#define WIDE 8
#elif defined __AVX__
#define WIDE 4
#else
#define WIDE 2
#endif
#define MOST (32 / WIDE)  /* vectors at a time, so that what a machine needs stays in the cache */
typedef double vec __attribute__((vector_size(WIDE * sizeof(double))));
typedef int64_t mask __attribute__((vector_size(WIDE * sizeof(int64_t))));
typedef int64_t whole;

/* Formulas of a lifting: registers hold [states; earlier values; inputs; parameters; constants; temporaries], one row of machines each. */
typedef struct {
    whole n;           /* states */
    whole earlier;     /* earlier values */
    whole m;           /* inputs */
    whole parameters;
    whole registers;
    whole constants;
    whole operations;
    whole slopes;
    const double *constant;   /* (constants) */
    const int32_t *code;      /* (operations, 4): what, into, from, from */
    const int32_t *lifted;    /* registers of [x; sigma] and of [u; gamma], in the order of a model's columns */
    whole n_lifted;
    whole n_inputs;
    const int32_t *shift;     /* (earlier): register that every earlier value has at the next sample */
    const int32_t *present;   /* (earlier): register of the quantity itself */
    const int32_t *slope;     /* (slopes, 3): column of a model, place among the entries asked for, register; none */
    const double *values;     /* (parameters, batch) */
} formulas;

/* An observer or free runs: [x+; c+] = map [theta; c; u; y], re-lifted at every sample. */
typedef struct {
    whole samples;
    whole batch;
    whole order;       /* of the correction */
    whole q;
    whole own;         /* every machine has a map of its own: map (batch, rows, columns) */
    whole fresh;       /* earlier values equal the present ones at the first sample */
    whole recorded;    /* first states; the last ones are those after a start, then their errors, and those from inputs alone; none */
    whole filters;     /* states behind the first ones, which are corrected when a measurement returns */
    whole patience;    /* measurements refused in a row, after which one is believed */
    const double *map;        /* (n + order, n_lifted + order + n_inputs + q) */
    const uint8_t *unsure;    /* (samples, batch): whether an input is not known; none */
    double *y;                /* (samples, q, batch); none where nothing is measured; of filter banks NaN in the end where refused */
    const double *u;          /* (samples, m, batch) */
    const int32_t *measured;  /* (q) */
    const double *low;        /* (n + order): bounds; none */
    const double *high;
    uint8_t *left;            /* (1): whether a machine would leave the bounds; all numbers are then of no use */
    double *column;           /* (columns, batch): x and c in their rows, moved on */
    double *past;             /* (batch, earlier), moved on */
    const double *reach;      /* (q) */
    const double *noise;      /* (q): errors of one step */
    const double *rest;       /* (q): errors of a first step where nothing has moved before */
    const double *gate;       /* (q) */
    const double *opening;    /* (q): how much wider gates are after a start, */
    const double *deviations; /* (q) and in standard deviations of what is not known */
    const double *start;      /* (filters, n_lifted + n_inputs) */
    const double *limits;     /* (2, recorded): of estimates before the fallback enters them */
    const double *half;       /* (recorded) */
    const double *recovery;   /* (1) */
    const double *doubt;      /* (filters, filters): covariance at a start */
    double *gap;              /* (5 q + 1 + (filters + q)^2, batch): counts of refused and believed, widths of gates, unrest, drift, age of the last start, covariance; moved on */
    double *states;           /* (samples, n, batch): x before every sample; none */
} relift_job;

/* Free runs with sensitivities: see kros.identify.refine.sensitivity for the symbols. */
typedef struct {
    whole samples;
    whole batch;
    whole per_unit;
    whole first;       /* sample to go on from, and the one to stop before */
    whole last;
    whole history;
    whole stride;
    whole terms;       /* n, and earlier values of states that move with the model */
    whole depth;       /* sensitivities that are kept: of now, and of so many samples before */
    whole rows;        /* of J that are written for one state and machine */
    const double *W;          /* (n, p, batch) */
    const double *T;          /* (p, p) */
    const int32_t *term;      /* (terms, 2): state, samples ago */
    const double *x;          /* (samples, n, batch) */
    const double *u;          /* (samples, m, batch) */
    const uint8_t *valid;     /* (samples, batch) */
    const double *sigma;      /* (n) */
    double *window;           /* (n + earlier, batch), moved on */
    double *S;                /* (depth, n, n p, batch), moved on; that of sample k lies at k mod depth */
    double *J;                /* (unit, n p + 1, rows, n, per_unit) */
} sensitivity_job;

enum { ADD, MULTIPLY, DIVIDE, POWER, SIN, COS, TAN, EXP, LOG, SQRT, TANH, ABS, SIGN, ATAN };

#define LANES(X) ((double *)(X))
#define EACH(EXPRESSION) for (whole b = 0; b < lanes; b++) { double x = LANES(from)[b]; LANES(into)[b] = (EXPRESSION); } break

static vec either(mask where, vec a, vec b) { return (vec)((where & (mask)a) | (~where & (mask)b)); }

#define POLYNOMIAL(X, A, B, C, D, E) ((A) + (X) * ((B) + (X) * ((C) + (X) * ((D) + (X) * (E)))))

/* Sine of x + quarters pi / 2 for many machines, to an error of about 1e-16: the kernels of Sun's fdlibm after a reduction by pi / 2 in two parts,
   which is exact below a million; beyond that, and for what is not finite, the C library is asked. */
static void sines(const vec *from, vec *into, whole lanes, whole quarters)
{
    for (whole v = 0; v < (lanes + WIDE - 1) / WIDE; v++) {
        const vec x = from[v], shift = x * 6.36619772367581382433e-01 + 0x1.8p52, count = shift - 0x1.8p52;
        const vec r = x - count * 1.57079632673412561417e+00, rest = count * 6.07710050650619224932e-11, a = r - rest, tail = (r - a) - rest;
        const vec z = a * a, cube = z * a, half = 0.5 * z, one = 1.0 - half;
        const vec p = POLYNOMIAL(z, 8.33333333332248946124e-03, -1.98412698298579493134e-04, 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10);
        const vec q = z * (4.16666666666666019037e-02 + z * POLYNOMIAL(z, -1.38888888888741095749e-03, 2.48015872894767294178e-05, -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11));
        const vec sine = a - ((z * (0.5 * tail - cube * p) - tail) - cube * -1.66666666666666324348e-01);
        const vec cosine = one + (((1.0 - one) - half) + (z * q - a * tail));
        const mask turns = (mask)shift + quarters, far = ~((x < 1e6) & (x > -1e6));
        into[v] = (vec)((mask)either(-(turns & 1), cosine, sine) ^ ((turns & 2) << 62));
        for (whole b = 0; b < WIDE; b++)
            if (far[b]) into[v][b] = quarters ? cos(x[b]) : sin(x[b]);
    }
}

static void evaluate(const formulas *f, vec *reg, whole lanes)
{
    const whole w = (lanes + WIDE - 1) / WIDE;
    const int32_t *code = f->code;
    for (whole i = 0; i < f->operations; i++, code += 4) {
        vec *into = reg + code[1] * MOST;
        const vec *from = reg + code[2] * MOST, *other = reg + code[3] * MOST;
        switch (code[0]) {
        case ADD: for (whole v = 0; v < w; v++) into[v] = from[v] + other[v]; break;
        case MULTIPLY: for (whole v = 0; v < w; v++) into[v] = from[v] * other[v]; break;
        case DIVIDE: for (whole v = 0; v < w; v++) into[v] = from[v] / other[v]; break;
        case POWER: for (whole b = 0; b < lanes; b++) LANES(into)[b] = pow(LANES(from)[b], LANES(other)[b]); break;
        case SIN: sines(from, into, lanes, 0); break;
        case COS: sines(from, into, lanes, 1); break;
        case TAN: EACH(tan(x));
        case EXP: EACH(exp(x));
        case LOG: EACH(log(x));
        case SQRT: EACH(sqrt(x));
        case TANH: EACH(tanh(x));
        case ABS: EACH(fabs(x));
        case SIGN: EACH(x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x);
        case ATAN: EACH(atan(x));
        }
    }
}

static void gather(vec *to, const double *from, whole stride, whole lanes)
{
    if (stride == 1) memcpy(to, from, (size_t)lanes * sizeof(double));
    else
        for (whole b = 0; b < lanes; b++) LANES(to)[b] = from[b * stride];
}

static void scatter(double *to, const vec *from, whole stride, whole lanes)
{
    if (stride == 1) memcpy(to, from, (size_t)lanes * sizeof(double));
    else
        for (whole b = 0; b < lanes; b++) to[b * stride] = LANES(from)[b];
}

static void *room(whole bytes)
{
    void *found = NULL;
    if (posix_memalign(&found, sizeof(vec), (size_t)(bytes > 0 ? bytes : 1))) return NULL;
    memset(found, 0, (size_t)bytes);
    return found;
}

static vec *vectors(whole count) { return room(count * MOST * (whole)sizeof(vec)); }

/* Constants and parameters of some machines into their registers. */
static void settle(const formulas *f, vec *reg, whole first, whole batch, whole lanes)
{
    vec *to = reg + (f->n + f->earlier + f->m) * MOST;
    for (whole i = 0; i < f->parameters; i++, to += MOST) gather(to, f->values + i * batch + first, 1, lanes);
    for (whole i = 0; i < f->constants; i++, to += MOST)
        for (whole b = 0; b < WIDE * MOST; b++) LANES(to)[b] = f->constant[i];
}

/* Earlier values of the next sample, into `next`. */
static void shifted(const formulas *f, const vec *reg, vec *next)
{
    for (whole e = 0; e < f->earlier; e++) memcpy(next + e * MOST, reg + f->shift[e] * MOST, MOST * sizeof(vec));
}

/* to = map column, four rows at a time, which have their own columns: those that are zero in all four cost nothing. */
static void product(const double *map, const whole *counts, const vec *const *column, vec *to, whole rows, whole w)
{
    for (whole i = 0; i < rows; i += 4, counts++) {
        for (whole v = 0; v < w; v++) {
            vec sums[4] = {{0}, {0}, {0}, {0}};
            const double *at = map;
            for (whole j = 0; j < *counts; j++, at += 4) {
                const vec x = column[j][v];
                sums[0] += at[0] * x, sums[1] += at[1] * x, sums[2] += at[2] * x, sums[3] += at[3] * x;
            }
            for (whole k = 0; k < 4 && i + k < rows; k++) to[(i + k) * MOST + v] = sums[k];
        }
        map += 4 * *counts, column += *counts;
    }
}

/* The same with a map of every machine's own. */
static void product_each(const vec *map, whole columns, const vec *const *column, vec *to, whole rows, whole w)
{
    for (whole i = 0; i < rows; i++)
        for (whole v = 0; v < w; v++) {
            vec sum = {0};
            for (whole j = 0; j < columns; j++) sum += map[(i * columns + j) * MOST + v] * column[j][v];
            to[i * MOST + v] = sum;
        }
}

/* Whether the next states and corrections of all machines are within the bounds. */
static int within(const relift_job *s, whole rows, const vec *next, whole lanes)
{
    int inside = 1;
    for (whole i = 0; s->low && i < rows; i++) {
        const double low = s->low[i], high = s->high[i];
        for (whole b = 0; b < lanes; b++) inside &= LANES(next + i * MOST)[b] >= low && LANES(next + i * MOST)[b] <= high;
    }
    return inside;
}

static int any(mask where) { int64_t some = 0; for (whole b = 0; b < WIDE; b++) some |= where[b]; return some != 0; }

static vec clipped(vec value, vec low, vec high) { return either(value < low, low, either(value > high, high, value)); }

static vec within_reach(vec x, vec near, double reach) { return near + clipped(x - near, (vec){0} - reach, (vec){0} + reach); }

static vec root(vec x) { for (whole b = 0; b < WIDE; b++) x[b] = x[b] > 0.0 ? sqrt(x[b]) : 0.0; return x; }

#define OLDEST (0.1 * exp(5.0)) /* age of a start; twice as much until a sample has all measurements */

/* Gaps of a filter bank, see kros.observer.filter_bank for the symbols. */
struct gaps {
    vec *gap;          /* (5 q + 1): as in the job, */
    vec *spread;       /* (MOST, filters + q, filters + q): and the covariance */
    vec *by;           /* (recorded + filters, q): slopes by the measurements */
    vec *moved;        /* (recorded + filters, filters + q): T P */
    whole *columns;    /* (recorded + filters, filters): which filters every row of T has, */
    whole *counts;     /* (recorded + filters) and how many */
    mask *missing;     /* (q) */
};
#define SPREAD(I, J) spread[(I) * size + (J)]

/* Measurements, and estimates in place of missing ones, into states; the filters are corrected by what arrives. */
static void fill(const relift_job *s, const struct gaps *g, vec *reg, vec *y, whole n, whole w)
{
    const whole r = s->filters, q = s->q, recorded = s->recorded, size = r + q;
    for (whole v = 0; v < w; v++) {
        vec *start = g->gap + 5 * q * MOST + v, *spread = g->spread + v * size * size, column[size];
        mask waits = *start > OLDEST, anew = {0}, complete = ~anew;
        for (whole j = 0; j < q; j++) {
            const whole i = s->measured[j] * MOST + v, row = j * MOST + v;
            vec *refusals = g->gap + row, *believed = refusals + q * MOST, *width = believed + q * MOST, *unrest = width + q * MOST;
            const vec seen = y[row], apart = either(seen > reg[i], seen - reg[i], reg[i] - seen), wide = s->deviations[j] * root(SPREAD(r + j, r + j));
            const vec near = s->gate[j] * (1.0 + *unrest) * (1.0 + s->opening[j] / (1.0 + *believed));
            const mask arrived = seen - seen == 0.0, outvoted = (*refusals >= (double)s->patience) | (*refusals + *unrest >= *believed);
            *width = either((*refusals > 0.0) & arrived, *width, wide);
            const mask refused = (apart > (near + *width) * (1.0 + *refusals)) & ~waits & ~outvoted;
            const mask starts = (apart > near + wide) & (*refusals > 0.0) & ~refused & ~waits;
            *believed = either(starts, (vec){0}, *believed);
            *unrest = either(arrived & ~refused, either(*refusals > *unrest * s->recovery[0], *refusals, *unrest * s->recovery[0]), *unrest);
            anew |= starts;
            *refusals = either(refused, *refusals + 1.0, either(arrived, (vec){0}, *refusals));
            g->missing[row] = ~arrived | refused;
            complete &= ~g->missing[row];
        }
        *start = either(anew & complete, (vec){0} + 2.0 * OLDEST, *start);
        waits = *start > OLDEST;
        mask begins = complete & ~waits, still = complete;
        for (whole j = 0; j < q; j++) {
            const vec apart = y[j * MOST + v] - reg[s->measured[j] * MOST + v];
            begins &= g->gap[(q + j) * MOST + v] == 1.0;
            still &= (apart <= s->rest[j]) & (apart >= -s->rest[j]);
        }
        for (whole i = 0; i < size * size && any(begins); i++) spread[i] = either(begins & still, (vec){0}, spread[i]);
        *start = either(begins & ~still, (vec){0}, *start);
        for (whole j = 0; j < q; j++) {
            const whole i = s->measured[j] * MOST + v, at = r + j;
            const mask lost = g->missing[j * MOST + v] & ~waits, arrived = ~g->missing[j * MOST + v] & ~waits;
            const vec variance = (vec){0} + s->noise[j] * s->noise[j];
            mask uncertain = {0};
            for (whole k = 0; k < size; k++) uncertain |= (column[k] = SPREAD(k, at)) != 0.0;
            if (any(uncertain & arrived)) {
                const vec count = 1.0 + g->gap[(q + j) * MOST + v], large = column[at] / (count * count * count * count);
                const vec share = either(arrived, 1.0 / (column[at] + large + variance), (vec){0}), moved = share * either(arrived, y[j * MOST + v] - reg[i], (vec){0});
                for (whole k = 0; k < r; k++) reg[(recorded + k) * MOST + v] += column[k] * moved;
                for (whole k = 0; k < q; k++) reg[s->measured[k] * MOST + v] += column[r + k] * moved;
                for (whole k = 0; k < size; k++)
                    for (whole l = 0; l < size; l++) SPREAD(k, l) -= column[k] * column[l] * share;
                for (whole k = 0; k < size; k++) SPREAD(k, at) = SPREAD(at, k) = either(arrived, (vec){0}, SPREAD(k, at));
            }
            SPREAD(at, at) += either(lost, variance, (vec){0});
        }
        for (whole j = 0; j < q; j++) {
            const whole i = s->measured[j] * MOST + v, row = j * MOST + v;
            vec *drift = g->gap + 4 * q * MOST + row;
            const vec fallback = reg[(n - recorded) * MOST + i];
            *drift = either(g->missing[row], *drift, y[row] - fallback);
            reg[i] = y[row] = either(g->missing[row], within_reach(reg[i], fallback + *drift, s->reach[j]), y[row]);
        }
    }
}

/* Filters start at the first sample that has all measurements. */
static void restart(const relift_job *s, const formulas *f, const struct gaps *g, vec *reg, vec *first, whole w)
{
    const whole columns = f->n_lifted + f->n_inputs, q = s->q, size = s->filters + q;
    for (whole v = 0; v < w; v++) {
        vec *start = g->gap + 5 * q * MOST + v, *spread = g->spread + v * size * size;
        mask begins = *start > OLDEST;
        for (whole j = 0; j < q; j++) begins &= ~g->missing[j * MOST + v];
        if (!any(begins)) continue;
        for (whole i = 0; i < s->filters; i++) {
            first[i] = (vec){0};
            for (whole j = 0; j < columns; j++) first[i] += s->start[i * columns + j] * reg[f->lifted[j] * MOST + v];
        }
        for (whole i = 0; i < s->filters; i++) reg[(s->recorded + i) * MOST + v] = either(begins, first[i], reg[(s->recorded + i) * MOST + v]);
        for (whole j = 0; j < q; j++) g->gap[(q + j) * MOST + v] = either(begins, (vec){0}, g->gap[(q + j) * MOST + v]);
        for (whole i = 0; i < size; i++)
            for (whole k = 0; k < size; k++) {
                const double doubt = i < s->filters && k < s->filters ? s->doubt[i * s->filters + k] : 0.0;
                SPREAD(i, k) = either(begins, (vec){0} + doubt, SPREAD(i, k));
            }
        *start = either(begins, (vec){0} + OLDEST, *start);
    }
}

/* The next covariance, and variances of the next recorded states in `variance`; false where all are zero. */
static int spread_on(const formulas *f, const vec *reg, const relift_job *s, const struct gaps *g, vec *variance, whole columns, whole v)
{
    const whole r = s->filters, q = s->q, recorded = s->recorded, rows = recorded + r, size = r + q;
    vec *spread = g->spread + v * size * size;
    mask some = {0}, uncertain = {0}, lost = {0}, forgotten = ~some;
    for (whole j = 0; j < q; j++) some |= g->missing[j * MOST + v];
    for (whole i = 0; i < size; i++) uncertain |= SPREAD(i, i) != 0.0;
    if (!any(some | uncertain)) return 0;
    for (whole i = 0; i < rows; i++) {
        const double *row = s->map + i * columns, *entry = row + recorded;
        const whole *column = g->columns + i * r;
        vec *by = g->by + i * q, *moved = g->moved + i * size, sum = {0};
        for (whole j = 0; j < q; j++) {
            by[j] = (vec){0} + row[s->measured[j]];
            for (const int32_t *slope = f->slope; slope < f->slope + 3 * f->slopes; slope += 3)
                if (slope[1] == j) by[j] += row[slope[0]] * reg[slope[2] * MOST + v];
        }
        for (whole k = 0; k < size; k++) {
            moved[k] = (vec){0};
            for (whole l = 0; l < g->counts[i]; l++) moved[k] += entry[column[l]] * SPREAD(column[l], k);
            for (whole j = 0; j < q; j++) moved[k] += by[j] * SPREAD(r + j, k);
        }
        if (i >= recorded) continue;
        for (whole l = 0; l < g->counts[i]; l++) sum += moved[column[l]] * entry[column[l]];
        for (whole j = 0; j < q; j++) sum += moved[r + j] * by[j];
        variance[i] = either(sum > 0.0, sum, (vec){0});
    }
    for (whole i = 0; i < recorded; i++) {
        double least = s->half[i];
        for (whole j = 0; j < q; j++)
            if (s->measured[j] == i) {
                least = s->noise[j];
                lost |= (variance[i] > s->reach[j] * s->reach[j]) & g->missing[j * MOST + v];
            }
        forgotten &= variance[i] <= 1e-6 * (least * least); /* AGREED of kros.core */
    }
    forgotten &= ~some;
    for (whole i = 0; i < size; i++)
        for (whole k = 0; k <= i; k++) {
            const whole from = i < r ? recorded + i : s->measured[i - r], to = k < r ? recorded + k : s->measured[k - r];
            const double *entry = s->map + to * columns + recorded;
            const vec *moved = g->moved + from * size;
            vec sum = {0};
            for (whole l = 0; l < g->counts[to]; l++) sum += moved[g->columns[to * r + l]] * entry[g->columns[to * r + l]];
            for (whole j = 0; j < q; j++) sum += moved[r + j] * g->by[to * q + j];
            SPREAD(i, k) = SPREAD(k, i) = either(lost, SPREAD(i, k), either(forgotten, (vec){0}, sum));
        }
    return 1;
}

/* The fallback into the next estimates; covariance and ages move on. */
static void follow(const formulas *f, const vec *reg, const relift_job *s, const struct gaps *g, vec *next, whole n, whole columns, whole w)
{
    const whole q = s->q, recorded = s->recorded;
    for (whole v = 0; v < w; v++) {
        vec *start = g->gap + 5 * q * MOST + v, variance[recorded];
        const mask waits = *start > OLDEST;
        const vec age = *start * *start, begun = age / (1.0 + age);
        const int uncertain = spread_on(f, reg, s, g, variance, columns, v);
        for (whole i = 0; i < recorded; i++) {
            const whole at = i * MOST + v;
            const double least = s->half[i] * s->half[i];
            double hidden = 1.0;
            for (whole j = 0; j < q; j++) hidden *= s->measured[j] != i;
            const vec weight = uncertain ? hidden * variance[i] / (variance[i] + least) : (vec){0};
            next[at] += begun * (next[(n - 2 * recorded) * MOST + at] - next[at]);
            next[at] = clipped(next[at], (vec){0} + s->limits[i], (vec){0} + s->limits[recorded + i]);
            const vec fallback = next[(n - recorded) * MOST + at];
            next[at] += either(waits, (vec){0} + 1.0, weight) * (fallback - next[at]);
            for (whole j = 0; j < q; j++)
                if (s->measured[j] == i) next[at] = within_reach(next[at], fallback + g->gap[(4 * q + j) * MOST + v], s->reach[j]);
            next[(n - 2 * recorded) * MOST + at] = uncertain ? root(variance[i]) : (vec){0};
        }
        for (whole j = 0; j < q; j++) g->gap[(q + j) * MOST + v] += either(g->missing[j * MOST + v], (vec){0}, (vec){0} + 1.0);
        *start *= either(waits, (vec){0} + 1.0, (vec){0} + s->recovery[0]);
    }
}

int kros_relift(const formulas *f, const relift_job *s)
{
    const whole n = f->n, ne = f->earlier, m = f->m, q = s->q, order = s->order, batch = s->batch, rows = n + order;
    const whole columns = f->n_lifted + order + f->n_inputs + q, recorded = s->recorded, size = s->filters + q, ages = recorded ? 5 * q + 1 : 0, known = recorded ? recorded + s->filters : 0;
    struct gaps g = {vectors(ages), vectors(recorded ? size * size : 0), room(known * q * (whole)sizeof(vec)), room(known * size * (whole)sizeof(vec)), room(known * s->filters * (whole)sizeof(whole)), room(known * (whole)sizeof(whole)), (mask *)vectors(q)};
    vec *reg = vectors(f->registers), *c = vectors(order), *y = vectors(q), *next = vectors(rows), *older = vectors(ne);
    vec *each = s->own ? vectors(rows * columns) : NULL;
    const whole groups = (rows + 3) / 4;
    double *map = room(4 * groups * columns * (whole)sizeof(double));
    const vec **column = room(groups * columns * (whole)sizeof(vec *));
    whole *counts = room(groups * (whole)sizeof(whole));
    int failed = !counts || !g.gap || !g.spread || !g.by || !g.moved || !g.columns || !g.counts || !g.missing || !reg || !c || !y || !next || !older || !map || !column || (s->own && !each);
    for (whole i = 0; i < known && !failed; i++)
        for (whole l = 0; l < s->filters; l++)
            if (s->map[i * columns + recorded + l] != 0.0) g.columns[i * s->filters + g.counts[i]++] = l;
    for (whole first = 0; first < batch && !failed; first += WIDE * MOST) {
        const whole lanes = batch - first < WIDE * MOST ? batch - first : WIDE * MOST, w = (lanes + WIDE - 1) / WIDE;
        settle(f, reg, first, batch, lanes);
        if (s->own)
            for (whole i = 0; i < rows * columns; i++) gather(each + i * MOST, s->map + first * rows * columns + i, rows * columns, lanes);
        for (whole i = 0; i < ages; i++) gather(g.gap + i * MOST, s->gap + i * batch + first, 1, lanes);
        for (whole i = 0; ages && i < size * size; i++)
            for (whole b = 0; b < lanes; b++) LANES(g.spread + b / WIDE * size * size + i)[b % WIDE] = s->gap[(ages + i) * batch + first + b];
        double *state = s->column + first, *past = s->past ? s->past + first * ne : NULL;
        for (whole i = 0; i < n; i++) gather(reg + i * MOST, state + i * batch, 1, lanes);
        for (whole i = 0; i < order; i++) gather(c + i * MOST, state + (f->n_lifted + i) * batch, 1, lanes);
        for (whole e = 0; e < ne; e++) gather(reg + (n + e) * MOST, past + e, ne, lanes);
        for (whole i = 0, used = 0, at = 0; i < rows; i += s->own ? rows : 4) {
            const whole before = used;
            for (whole j = 0; j < columns; j++) {
                const double *from = s->map + i * columns + j;
                whole there = s->own, k = j;
                for (whole l = 0; l < 4 && i + l < rows && !there; l++) there = from[l * columns] != 0.0;
                if (!there) continue;
                if (k < f->n_lifted) column[used++] = reg + f->lifted[k] * MOST;
                else if ((k -= f->n_lifted) < order) column[used++] = c + k * MOST;
                else if ((k -= order) < f->n_inputs) column[used++] = reg + f->lifted[f->n_lifted + k] * MOST;
                else column[used++] = y + (k - f->n_inputs) * MOST;
                for (whole l = 0; l < 4 && !s->own; l++) map[at++] = i + l < rows ? from[l * columns] : 0.0;
            }
            counts[i / 4] = used - before;
        }
        for (whole k = 0; k < s->samples; k++) {
            if (s->states)
                for (whole i = 0; i < n; i++) scatter(s->states + (k * n + i) * batch + first, reg + i * MOST, 1, lanes);
            for (whole j = 0; j < q; j++) { /* what is predicted stands for what is missing */
                const vec *x = reg + s->measured[j] * MOST;
                gather(y + j * MOST, s->y + (k * q + j) * batch + first, 1, lanes);
                for (whole v = 0; v < w && !recorded; v++) {
                    const vec seen = y[j * MOST + v];
                    y[j * MOST + v] = either(seen - seen == 0.0, seen, x[v]);
                }
            }
            for (whole i = 0; i < q * lanes && recorded; i++)
                if (s->unsure[k * batch + first + i % lanes]) LANES(g.gap + (q + i / lanes) * MOST)[i % lanes] = 0.0;
            if (recorded) fill(s, &g, reg, y, n, w);
            for (whole j = 0; j < q && recorded; j++) {
                for (whole v = 0; v < w; v++) next[v] = either(g.missing[j * MOST + v], (vec){0} + NAN, y[j * MOST + v]);
                scatter(s->y + (k * q + j) * batch + first, next, 1, lanes);
            }
            for (whole j = 0; j < m; j++) gather(reg + (n + ne + j) * MOST, s->u + (k * m + j) * batch + first, 1, lanes);
            for (whole e = 0; e < ne && s->fresh && k == 0; e++) memcpy(reg + (n + e) * MOST, reg + f->present[e] * MOST, MOST * sizeof(vec));
            evaluate(f, reg, lanes);
            if (recorded) restart(s, f, &g, reg, next, w);
            if (s->own) product_each(each, columns, column, next, rows, w);
            else product(map, counts, column, next, rows, w);
            shifted(f, reg, older);
            if (recorded) follow(f, reg, s, &g, next, n, columns, w);
            if (!within(s, rows, next, lanes)) {
                s->left[0] = 1;
                break;
            }
            memcpy(reg, next, (size_t)n * MOST * sizeof(vec));
            memcpy(c, next + n * MOST, (size_t)order * MOST * sizeof(vec));
            memcpy(reg + n * MOST, older, (size_t)ne * MOST * sizeof(vec));
        }
        for (whole i = 0; i < n; i++) scatter(state + i * batch, reg + i * MOST, 1, lanes);
        for (whole i = 0; i < order; i++) scatter(state + (f->n_lifted + i) * batch, c + i * MOST, 1, lanes);
        for (whole e = 0; e < ne; e++) scatter(past + e, reg + (n + e) * MOST, ne, lanes);
        for (whole i = 0; i < ages; i++) scatter(s->gap + i * batch + first, g.gap + i * MOST, 1, lanes);
        for (whole i = 0; ages && i < size * size; i++)
            for (whole b = 0; b < lanes; b++) s->gap[(ages + i) * batch + first + b] = LANES(g.spread + b / WIDE * size * size + i)[b % WIDE];
    }
    free(g.gap), free(g.spread), free(g.by), free(g.moved), free(g.columns), free(g.counts), free(g.missing), free(reg), free(c), free(y), free(next), free(older), free(each), free(map), free(column), free(counts);
    return failed;
}

int kros_sensitivities(const formulas *f, const sensitivity_job *s)
{
    const whole n = f->n, ne = f->earlier, m = f->m, batch = s->batch, p = f->n_lifted + f->n_inputs, np = n * p, terms = s->terms;
    vec *reg = vectors(f->registers), *W = vectors(n * p), *F = vectors(n * terms), *S = vectors(s->depth * n * np), *white = vectors(p);
    vec *next = vectors(n), *older = vectors(ne);
    const vec **psi = room(p * (whole)sizeof(vec *)), **term = room(terms * (whole)sizeof(vec *));
    const int failed = !reg || !W || !F || !S || !white || !next || !older || !psi || !term;
    for (whole first = 0; first < batch && !failed; first += WIDE * MOST) {
        const whole lanes = batch - first < WIDE * MOST ? batch - first : WIDE * MOST, w = (lanes + WIDE - 1) / WIDE;
        settle(f, reg, first, batch, lanes);
        for (whole i = 0; i < np; i++) gather(W + i * MOST, s->W + i * batch + first, 1, lanes);
        for (whole i = 0; i < n + ne; i++) gather(reg + i * MOST, s->window + i * batch + first, 1, lanes);
        for (whole i = 0; i < s->depth * n * np; i++) gather(S + i * MOST, s->S + i * batch + first, 1, lanes);
        for (whole j = 0; j < p; j++) psi[j] = reg + f->lifted[j] * MOST;
        for (whole k = s->first, sample = 0; k < s->last; k++) {
            for (whole j = 0; j < m; j++) gather(reg + (n + ne + j) * MOST, s->u + (k * m + j) * batch + first, 1, lanes);
            evaluate(f, reg, lanes);
            for (whole a = 0; a < n; a++)
                for (whole t = 0; t < terms; t++)
                    for (whole v = 0; v < w; v++) F[(a * terms + t) * MOST + v] = t < n ? W[(a * p + t) * MOST + v] : (vec){0};
            for (whole i = 0; i < f->slopes; i++) {
                const int32_t *of = f->slope + 3 * i;
                for (whole a = 0; a < n; a++)
                    for (whole v = 0; v < w; v++) F[(a * terms + of[1]) * MOST + v] += W[(a * p + of[0]) * MOST + v] * reg[of[2] * MOST + v];
            }
            for (whole j = 0; j < p; j++) {
                memset(white + j * MOST, 0, MOST * sizeof(vec));
                for (whole i = 0; i < p; i++)
                    if (s->T[i * p + j] != 0.0)
                        for (whole v = 0; v < w; v++) white[j * MOST + v] += s->T[i * p + j] * psi[i][v];
            }
            for (whole t = 0; t < terms; t++) /* before the start nothing moves */
                term[t] = S + (((k - s->term[2 * t + 1] + s->depth) % s->depth) * n + s->term[2 * t]) * np * MOST;
            vec *moved = S + ((k + 1) % s->depth) * n * np * MOST;
            for (whole a = 0; a < n; a++) {
                vec *into = moved + a * np * MOST;
                const vec *by = F + a * terms * MOST;
                for (whole i = 0; i < np; i++)
                    for (whole v = 0; v < w; v++) {
                        vec sum = term[0][i * MOST + v] * by[v];
                        for (whole t = 1; t < terms; t++) sum += term[t][i * MOST + v] * by[t * MOST + v];
                        into[i * MOST + v] = sum;
                    }
                for (whole j = 0; j < p; j++)
                    for (whole v = 0; v < w; v++) into[(a * p + j) * MOST + v] += white[j * MOST + v];
            }
            product_each(W, p, psi, next, n, w);
            shifted(f, reg, older);
            memcpy(reg, next, (size_t)n * MOST * sizeof(vec));
            memcpy(reg + n * MOST, older, (size_t)ne * MOST * sizeof(vec));
            if ((k + 1 - s->history) % s->stride) continue;
            for (whole b = 0; b < lanes; b++) {
                const whole unit = (first + b) / s->per_unit, step = s->rows * n * s->per_unit;
                double *J = s->J + unit * (np + 1) * step + sample * n * s->per_unit + (first + b) % s->per_unit;
                const int valid = s->valid[(k + 1) * batch + first + b];
                for (whole a = 0; a < n; a++, J += s->per_unit) {
                    const double *from = LANES(moved + a * np * MOST) + b;
                    for (whole i = 0; i < np; i++) J[i * step] = valid ? from[i * MOST * WIDE] / s->sigma[a] : 0.0;
                    J[np * step] = valid ? (s->x[((k + 1) * n + a) * batch + first + b] - LANES(reg + a * MOST)[b]) / s->sigma[a] : 0.0;
                }
            }
            sample++;
        }
        for (whole i = 0; i < n + ne; i++) scatter(s->window + i * batch + first, reg + i * MOST, 1, lanes);
        for (whole i = 0; i < s->depth * n * np; i++) scatter(s->S + i * batch + first, S + i * MOST, 1, lanes);
    }
    free(reg), free(W), free(F), free(S), free(white), free(next), free(older), free(psi), free(term);
    return failed;
}
