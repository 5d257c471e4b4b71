#include "axis_sketch.ino"
int main() {
  setup();
  for (int i = 0; i < 100000; i++) loop();
}
