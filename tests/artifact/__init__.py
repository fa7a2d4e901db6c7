"""Tests of ``ttscompile.artifact``."""
