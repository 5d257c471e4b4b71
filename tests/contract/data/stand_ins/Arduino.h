#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#define A0 0
static uint32_t clock_us;
static uint32_t micros() { return clock_us += 7; }
static uint32_t millis() { return clock_us / 1000; }
static void delay(int) {}
static int analogRead(int) { return 300; }
struct Port {
  void begin(long) {}
  template <class T> void print(T value, int = 0) { printf("%g ", (double)value); }
  void print(char) {}
  void println(const char *text) { puts(text); }
  void println(uint32_t value) { printf("%u\n", (unsigned)value); }
};
static Port Serial;
