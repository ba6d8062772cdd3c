"""Mutation testing of the core: small faults are put in, and the tests should notice each of them.

``make mutants`` runs it; CI does not, because it takes hours. Why not a published tool: mutmut 3.8
leaves out functions with decorators, such as ``MOPSNet.tau`` and ``attend``, and values of modules
and classes, and has neither swapped elements nor sums in place of means. cosmic-ray starts a
process per mutant, which here imports torch and Lightning each time; a fork needs a tenth of that.
"""
