"""What a policy is and what a call of it means (design, sections 1 and 2), in numpy; every other part builds on this.

- ``spec``: what surrounds the network: sampler table, observations, chunk.
- ``lattice``: sources, plans and which of them are legal.
- ``correction``: the linear correction of a plan.
- ``update``: sampler and correction of one step as one matrix product.
- ``untrusted_json``: the one reader of JSON that somebody else wrote.

Functions that are given a class of errors, ``error``, raise that: what comes from a caller is the caller's.
"""
