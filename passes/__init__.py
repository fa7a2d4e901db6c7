"""Graph passes, one a file; installed as ``ttscompile.passes``. They import neither each other nor any runtime."""
