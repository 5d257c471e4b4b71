/* A Cortex-M4F under QEMU (mps2-an386): start, self-test, and what a step costs, printed by semihosting. */
#include HEADER

#define JOINED(name, part) name##part
#define OF(name, part) JOINED(name, part) /* name and part with macros read */

#define SYSTICK ((volatile uint32_t *)0xE000E010)
#define STEPS 1000
#define BEFORE 6000 /* until the start is over and the monitor watches */

extern unsigned _sidata, _sdata, _edata, _sbss, _ebss, _estack;
static OF(NAME, _state) observer;

static void semihost(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

static void number(const char *name, uint32_t value)
{
    char text[12];
    int at = 11;
    text[11] = '\0';
    do {
        text[--at] = (char)('0' + value % 10u);
        value /= 10u;
    } while (value != 0u);
    semihost(4, name);
    semihost(4, " ");
    semihost(4, text + at);
    semihost(4, "\n");
}

__attribute__((noinline)) static void measure(void) /* apart from reset: its first instructions use the floating-point unit */
{
    OF(NAME, _real) y[OF(UPPER, _MEASURED)] = { 0 }, u[OF(UPPER, _INPUTS) + 1] = { 0 }, x_hat[OF(UPPER, _STATES)];
    uint32_t before, after;
    int k;
    number("selftest", (uint32_t)OF(NAME, _selftest)());
    number("state_bytes", (uint32_t)sizeof(observer));
    OF(NAME, _init)(&observer);
    OF(NAME, _reset)(&observer, y);
    SYSTICK[1] = 0xFFFFFF;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5; /* counts the processor's clock, 25 MHz: with one instruction a nanosecond, 40 instructions a tick */
    before = 0u;
    for (k = 0; k < BEFORE + STEPS; k++) {
        if (k == BEFORE) {
            before = SYSTICK[2];
        }
        y[0] = 5e-4f * (OF(NAME, _real))(k % 1000);
        u[0] = y[0];
        (void)OF(NAME, _step)(&observer, y, u, x_hat);
    }
    after = SYSTICK[2];
    number("instructions_a_step", ((before - after) & 0xFFFFFFu) * 40u / STEPS);
    semihost(0x18, (const void *)0x20026);
}

void reset(void);
void reset(void)
{
    unsigned *to = &_sdata;
    const unsigned *from = &_sidata;
    *(volatile unsigned *)0xE000ED88 |= 0xFu << 20; /* the floating-point unit */
    __asm__ volatile("dsb; isb");
    while (to < &_edata) {
        *to++ = *from++;
    }
    for (to = &_sbss; to < &_ebss;) {
        *to++ = 0;
    }
    measure();
    for (;;) {
    }
}

static void hang(void)
{
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const void *const vectors[8] = { &_estack, (const void *)reset, (const void *)hang, (const void *)hang, (const void *)hang,
    (const void *)hang, (const void *)hang, (const void *)hang };
