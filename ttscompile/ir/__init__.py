"""The intermediate representation: immutable graphs of ATen operations, and the program that passes rewrite."""
