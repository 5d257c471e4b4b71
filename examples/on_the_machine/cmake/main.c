/* Estimates of a recording: position,target_position,target_velocity a line in, position,velocity,current,status out. The argument is the phase, or
   `selftest`. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "axis.h"

#define CHANNELS (AXIS_MEASURED + AXIS_INPUTS)

/* Read numbers between commas; NaN where there is none. */
static void read_line(const char *line, axis_real *value)
{
    int i;
    for (i = 0; i < CHANNELS; i++) {
        char *end;
        const double found = strtod(line, &end);
        value[i] = (axis_real)(end == line ? (double)NAN : found);
        for (line = end; *line != '\0' && *line != ','; line++) {
        }
        line += *line == ',';
    }
}

int main(int count, char **arguments)
{
    axis_state state;
    axis_real sample[CHANNELS], x_hat[AXIS_STATES];
    char line[1024];
    int started = 0;
    if (count > 1 && strcmp(arguments[1], "selftest") == 0) {
        return axis_selftest();
    }
    axis_init(&state);
    if (count > 1) {
        axis_set_phase(&state, (axis_real)atof(arguments[1]));
    }
    while (fgets(line, sizeof(line), stdin) != NULL) {
        uint32_t status;
        int i;
        read_line(line, sample);
        if (!started) {
            axis_reset(&state, sample);
            started = 1;
        }
        status = axis_step(&state, sample, sample + AXIS_MEASURED, x_hat);
        for (i = 0; i < AXIS_STATES; i++) {
            printf("%.17g,", (double)x_hat[i]);
        }
        printf("%u\n", (unsigned)status);
    }
    return 0;
}
