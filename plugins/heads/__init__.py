"""Action heads of vision-language-action models, read from the checkpoints that their authors' code wrote.

Each is one module with the network and ``load``, and one row in ``ttscompile/frontends/families.py``. What the rest of
the model gives a head is what it observes.
"""
