"""The observer problem in six forms of uncertainty, and the generalized plants that belong to it."""
