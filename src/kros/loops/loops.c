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
    whole recorded;    /* first states; the last ones are those after a start, those from inputs alone, and how far apart they are; none */
    whole kinds;       /* of ages, in pairs of the second readout and the fallback: of losses of all measurements, and of some */
    whole filters;     /* states behind the first ones, which are corrected when a measurement returns */
    whole patience;    /* measurements refused in a row, after which one is believed */
    const double *map;        /* (n + order, n_lifted + order + n_inputs + q) */
    double *y;                /* (samples, q, batch); none where nothing is measured; of filter banks NaN in the end where refused */
    const double *u;          /* (samples, m, batch) */
    const int32_t *measured;  /* (q) */
    const double *low;        /* (n + order): bounds; none */
    const double *high;
    uint8_t *left;            /* (1): whether a machine would leave the bounds; all numbers are then of no use */
    double *column;           /* (columns, batch): x and c in their rows, moved on */
    double *past;             /* (batch, earlier), moved on */
    const double *reach;      /* (recorded) */
    const double *gate;       /* (q) */
    const double *opening;    /* (q): how much wider gates are after a start */
    const double *pull;       /* (recorded, q) */
    const double *start;      /* (filters, n_lifted + n_inputs) */
    const double *limits;     /* (2, recorded): of estimates before the fallback enters them */
    const double *half;       /* (kinds, recorded) */
    const double *recovery;   /* (2): of the readout after losses, and of the fallback and a start */
    double *gap;              /* (kinds recorded + 3 q + 2 + q filters, batch): ages, counts of missing, refused and believed, ages of the last and the first start, ramps; moved on */
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

static int any(mask where)
{
    int64_t some = 0;
    for (whole b = 0; b < WIDE; b++) some |= where[b];
    return some != 0;
}

static vec clipped(vec value, vec low, vec high)
{
    return either(value < low, low, either(value > high, high, value));
}

#define OLDEST (0.1 * exp(5.0)) /* age of a start; twice as much until a sample has all measurements */

static vec level(vec age, vec half)
{
    const vec ratio = age / half;
    return ratio * ratio / (1.0 + ratio * ratio);
}

/* How much the readout after losses (0) or the fallback (1) counts for a state: the most of losses of all and of some measurements. */
static vec counted(const relift_job *s, const vec *gap, whole at, whole which)
{
    const vec start = gap[(s->kinds * s->recorded + 3 * s->q) * MOST + at % MOST];
    vec most = either(start > OLDEST, (vec){0} + 1.0, (vec){0});
    for (whole k = which; k < s->kinds; k += 2) {
        const vec share = level(gap[k * s->recorded * MOST + at], (vec){0} + s->half[k * s->recorded + at / MOST]);
        most = either(share > most, share, most);
    }
    return most;
}

/* Gaps of a filter bank, see kros.observer.filter_bank for the symbols: measurements and what stands for missing ones, into states; straight lines
   over gaps that end. */
static void fill(const relift_job *s, vec *gap, vec *reg, vec *y, mask *missing, whole n, whole w)
{
    const whole r = s->filters, recorded = s->recorded, ages = s->kinds * recorded;
    const vec *from_inputs = reg + (n - 2 * recorded) * MOST;
    vec *offset = reg + (n - recorded) * MOST;
    for (whole v = 0; v < w; v++) {
        vec *start = gap + (ages + 3 * s->q) * MOST + v;
        mask waits = *start > OLDEST, anew = {0}, complete = ~anew;
        for (whole j = 0; j < s->q; j++) {
            const whole i = s->measured[j] * MOST + v, row = j * MOST + v;
            vec *refusals = gap + (ages + s->q) * MOST + row, *believed = refusals + s->q * MOST;
            const vec seen = y[row], missed = 1.0 + gap[ages * MOST + row] - *refusals, apart = either(seen > reg[i], seen - reg[i], reg[i] - seen);
            const vec close = s->gate[j] * (1.0 + s->opening[j] / (1.0 + *believed)), far = close * (missed * missed);
            const mask arrived = seen - seen == 0.0, outvoted = (*refusals >= (double)s->patience) | (*refusals >= *believed);
            const mask refused = (apart > far * (1.0 + *refusals)) & ~outvoted & ~waits, starts = (apart > far) & (*refusals > 0.0) & ~refused & ~waits;
            *believed = either(~refused & (apart > close), (vec){0}, *believed);
            *start = either(starts, (vec){0} + OLDEST, *start);
            anew |= starts & outvoted;
            *refusals = either(refused, *refusals + 1.0, either(arrived, (vec){0}, *refusals));
            missing[row] = ~arrived | refused;
            complete &= ~missing[row];
        }
        *start = either(anew & complete, (vec){0} + 2.0 * OLDEST, *start);
        waits = *start > OLDEST;
        for (whole j = 0; j < s->q; j++) {
            const whole i = s->measured[j] * MOST + v, row = j * MOST + v;
            const vec seen = y[row], count = gap[ages * MOST + row], held = from_inputs[i] + offset[i], reach = s->reach[s->measured[j]] * (1.0 + start[MOST]);
            const vec near = clipped(reg[i] - held, -reach, reach);
            const mask ends = ~missing[row] & ~waits & (count > 0.0);
            const vec jump = either(ends, (seen - (held + near)) / (count + 1.0), (vec){0});
            for (whole l = 0; l < r && any(ends); l++) reg[(recorded + l) * MOST + v] += gap[(ages + 3 * s->q + 2 + j * r + l) * MOST + v] * jump;
            reg[i] = y[row] = either(missing[row], held + near, seen);
        }
    }
    vec innovation[s->q * MOST];
    for (whole j = 0; j < s->q; j++)
        for (whole v = 0; v < w; v++) {
            const whole at = s->measured[j] * MOST + v;
            innovation[j * MOST + v] = reg[at] - from_inputs[at] - offset[at];
        }
    for (whole i = 0; i < recorded; i++)
        for (whole v = 0; v < w; v++) {
            const whole at = i * MOST + v;
            mask lost = {0};
            int hidden = 1;
            for (whole j = 0; j < s->q; j++) {
                lost |= missing[j * MOST + v];
                hidden &= s->measured[j] != i;
            }
            const vec share = either(lost, (vec){0}, 1.0 - hidden * counted(s, gap, at, 1));
            vec pulled = offset[at];
            for (whole j = 0; j < s->q; j++) pulled += s->pull[i * s->q + j] * either(lost, (vec){0}, innovation[j * MOST + v]);
            const vec moved = pulled + share * (reg[at] - from_inputs[at] - pulled);
            const double most = hidden ? s->reach[i] : INFINITY;
            offset[at] = clipped(moved, (vec){0} - most, (vec){0} + most);
        }
}

/* Filters start at the first sample that has all measurements. */
static void restart(const relift_job *s, const formulas *f, vec *gap, vec *reg, vec *first, const mask *missing, whole w)
{
    const whole columns = f->n_lifted + f->n_inputs, ages = s->kinds * s->recorded;
    for (whole v = 0; v < w; v++) {
        vec *start = gap + (ages + 3 * s->q) * MOST + v;
        mask begins = *start > OLDEST;
        for (whole j = 0; j < s->q; j++) begins &= ~missing[j * MOST + v];
        if (!any(begins)) continue;
        for (whole i = 0; i < s->filters; i++) {
            first[i] = (vec){0};
            for (whole j = 0; j < columns; j++) first[i] += s->start[i * columns + j] * reg[f->lifted[j] * MOST + v];
        }
        for (whole i = 0; i < s->filters; i++) reg[(s->recorded + i) * MOST + v] = either(begins, first[i], reg[(s->recorded + i) * MOST + v]);
        for (whole j = 0; j < s->q; j++) gap[(ages + 2 * s->q + j) * MOST + v] = either(begins, (vec){0}, gap[(ages + 2 * s->q + j) * MOST + v]);
        *start = either(begins, (vec){0} + OLDEST, *start);
    }
}

/* The fallback into the next estimates; ages and ramps move on. */
static void follow(const formulas *f, const vec *reg, const relift_job *s, vec *gap, vec *next, const mask *missing, vec *ramp, whole n, whole columns, whole w)
{
    const whole r = s->filters, q = s->q, recorded = s->recorded, ages = s->kinds * recorded;
    for (whole v = 0; v < w; v++) {
        mask some = {0}, all = ~some;
        vec longest = {0}, shortest = (vec){0} + INFINITY;
        for (whole j = 0; j < q; j++) {
            const mask lost = missing[j * MOST + v];
            vec *count = gap + (ages + j) * MOST + v, *believed = count + 2 * q * MOST, *of = gap + (ages + 3 * q + 2 + j * r) * MOST + v;
            const int moves = any(lost | (*count > 0.0));
            *count = either(lost, *count + 1.0, (vec){0});
            *believed += either(lost, (vec){0}, (vec){0} + 1.0);
            longest = either(*count > longest, *count, longest);
            shortest = either(*count < shortest, *count, shortest);
            some |= lost;
            all &= lost;
            for (whole i = 0; i < r && moves; i++) {
                const double *row = s->map + (recorded + i) * columns;
                vec slope = (vec){0} + row[s->measured[j]], sum = {0};
                for (const int32_t *by = f->slope; by < f->slope + 3 * f->slopes; by += 3)
                    if (by[1] == j) slope += row[by[0]] * reg[by[2] * MOST + v];
                for (whole l = 0; l < r; l++) sum += row[recorded + l] * of[l * MOST];
                ramp[i] = sum + slope * *count;
            }
            for (whole i = 0; i < r && moves; i++) of[i * MOST] = either(lost, ramp[i], (vec){0});
        }
        vec *start = gap + (ages + 3 * q) * MOST + v, *first = start + MOST;
        const vec begun = level(*start, (vec){0} + 1.0), further = 1.0 + *first;
        *start *= either(*start > OLDEST, (vec){0} + 1.0, (vec){0} + s->recovery[1]);
        *first *= s->recovery[1];
        for (whole k = 0; k < s->kinds; k++) {
            const mask lost = k > 1 ? some : all;
            const vec gone = k > 1 ? either(all, (vec){0}, longest) : shortest;
            for (whole i = 0; i < recorded; i++) {
                const whole at = (k * recorded + i) * MOST + v;
                const vec oldest = (vec){0} + OLDEST * s->half[k * recorded + i], old = gap[at];
                const vec recovered = either(lost, old, s->recovery[k % 2] * either(old > oldest, oldest, old));
                gap[at] = either(gone > recovered, gone, recovered);
            }
        }
        for (whole i = 0; i < recorded; i++) {
            const whole at = i * MOST + v;
            int hidden = 1;
            for (whole j = 0; j < q; j++) hidden &= s->measured[j] != i;
            next[at] += begun * (next[(n - 4 * recorded) * MOST + at] - next[at]);
            next[at] += counted(s, gap, at, 0) * (next[(n - 3 * recorded) * MOST + at] - next[at]);
            next[at] = clipped(next[at], (vec){0} + s->limits[i], (vec){0} + s->limits[recorded + i]);
            const vec fallback = next[(n - 2 * recorded) * MOST + at] + next[(n - recorded) * MOST + at];
            const vec reach = s->reach[i] * further, apart = next[at] - fallback;
            if (hidden) next[at] -= counted(s, gap, at, 1) * apart;
            else next[at] = either(some, fallback + clipped(apart, -reach, reach), next[at]);
        }
    }
}

int kros_relift(const formulas *f, const relift_job *s)
{
    const whole n = f->n, ne = f->earlier, m = f->m, q = s->q, order = s->order, batch = s->batch, rows = n + order;
    const whole columns = f->n_lifted + order + f->n_inputs + q, recorded = s->recorded, gaps = recorded ? s->kinds * recorded + 3 * q + 2 + q * s->filters : 0;
    vec *gap = vectors(gaps), *missing = vectors(q), *ramp = vectors(s->filters);
    vec *reg = vectors(f->registers), *c = vectors(order), *y = vectors(q), *next = vectors(rows), *older = vectors(ne);
    vec *each = s->own ? vectors(rows * columns) : NULL;
    const whole groups = (rows + 3) / 4;
    double *map = room(4 * groups * columns * (whole)sizeof(double));
    const vec **column = room(groups * columns * (whole)sizeof(vec *));
    whole *counts = room(groups * (whole)sizeof(whole));
    int failed = !counts || !gap || !missing || !ramp || !reg || !c || !y || !next || !older || !map || !column || (s->own && !each);
    for (whole first = 0; first < batch && !failed; first += WIDE * MOST) {
        const whole lanes = batch - first < WIDE * MOST ? batch - first : WIDE * MOST, w = (lanes + WIDE - 1) / WIDE;
        settle(f, reg, first, batch, lanes);
        if (s->own)
            for (whole i = 0; i < rows * columns; i++) gather(each + i * MOST, s->map + first * rows * columns + i, rows * columns, lanes);
        for (whole i = 0; i < gaps; i++) gather(gap + i * MOST, s->gap + i * batch + first, 1, lanes);
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
            if (recorded) fill(s, gap, reg, y, (mask *)missing, n, w);
            for (whole j = 0; j < q && recorded; j++) {
                for (whole v = 0; v < w; v++) next[v] = either(((mask *)missing)[j * MOST + v], (vec){0} + NAN, y[j * MOST + v]);
                scatter(s->y + (k * q + j) * batch + first, next, 1, lanes);
            }
            for (whole j = 0; j < m; j++) gather(reg + (n + ne + j) * MOST, s->u + (k * m + j) * batch + first, 1, lanes);
            for (whole e = 0; e < ne && s->fresh && k == 0; e++) memcpy(reg + (n + e) * MOST, reg + f->present[e] * MOST, MOST * sizeof(vec));
            evaluate(f, reg, lanes);
            if (recorded) restart(s, f, gap, reg, next, (const mask *)missing, w);
            if (s->own) product_each(each, columns, column, next, rows, w);
            else product(map, counts, column, next, rows, w);
            shifted(f, reg, older);
            if (recorded) follow(f, reg, s, gap, next, (const mask *)missing, ramp, n, columns, w);
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
        for (whole i = 0; i < gaps; i++) scatter(s->gap + i * batch + first, gap + i * MOST, 1, lanes);
    }
    free(gap), free(missing), free(ramp), free(reg), free(c), free(y), free(next), free(older), free(each), free(map), free(column), free(counts);
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
