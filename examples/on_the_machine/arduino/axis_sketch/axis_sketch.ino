// An observer on a board: one step a period, an estimate ten times a second on the serial port. axis.h and axis.c lie beside this file.
#include <Arduino.h>

#include "axis.h"

static const uint32_t PERIOD_US = (uint32_t)(1e6 * AXIS_SAMPLE_PERIOD_S + 0.5);
static const uint32_t SHOW_MS = 100;

static axis_state observer;
static uint32_t due_us, shown_ms, slowest_us;
static bool started = false;

// What arrives in this period, in the recordings' units; NAN for a measurement that did not. Replace it by your encoder and your controller's reference.
static void read_sample(axis_real *y, axis_real *u) {
  y[0] = (axis_real)analogRead(A0) * (axis_real)(6.2831853 / 1024.0);  // position, rad
  u[0] = y[0];                                                        // target_position, rad
  u[1] = 0;                                                           // target_velocity, rad/s
}

void setup() {
  Serial.begin(115200);
  axis_init(&observer);
  axis_set_phase(&observer, 1.2f);  // this machine's own
  if (axis_selftest() != 0) {
    while (true) {
      Serial.println("the golden vectors do not agree: compile without -ffast-math");
      delay(1000);
    }
  }
  due_us = micros();
}

void loop() {
  if ((int32_t)(micros() - due_us) < 0) {
    return;
  }
  due_us += PERIOD_US;

  axis_real y[AXIS_MEASURED], u[AXIS_INPUTS], x_hat[AXIS_STATES];
  read_sample(y, u);
  if (!started) {
    axis_reset(&observer, y);
    started = true;
  }
  const uint32_t before = micros();
  const uint32_t status = axis_step(&observer, y, u, x_hat);
  const uint32_t took = micros() - before;
  slowest_us = took > slowest_us ? took : slowest_us;

  if (millis() - shown_ms >= SHOW_MS) {
    shown_ms = millis();
    for (int i = 0; i < AXIS_STATES; i++) {
      Serial.print((float)x_hat[i], 5);
      Serial.print('\t');
    }
    Serial.print(status);
    Serial.print('\t');
    Serial.println(slowest_us);
  }
}
