"""Denoising loops as tables of numbers: from diffusers' schedulers, and flow matching by its definition."""
