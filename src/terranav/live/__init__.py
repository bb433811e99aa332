"""The running engine and its links: what a vehicle says goes in, fixes come out.

`records` is what travels: a Packet in, a Fix or a Remark out. `engine.Engine` is a function of its packets alone: it
has no clock, no socket and no file, so what was recorded replays to the same bits. Links, outputs, recorder and
checkpoints stand around it.
"""
