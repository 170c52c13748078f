"""What the rules ask: plan, stages, inputs, jobs, GPUs and measured costs. Every process of Snakemake imports it, so
that it imports nothing heavy."""

import os
import sys
from pathlib import Path

from drivesplat.provenance.code.code_states import code_states

IN_SCRIPT = hasattr(sys.modules["__main__"], "snakemake")
"""Whether this runs in a rule's script, which imports this package before all others."""
CODE_AT_START = code_states(Path(__file__).parents[1]) if IN_SCRIPT else {}
"""The states of the library's files before a rule's script imports them."""

# Stages have threads of their own. Snakemake asks OpenBLAS for as many again, which wait actively during small matrix
# products: a fifth of the processor time of `masks` with two threads.
if IN_SCRIPT:
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read when numpy is imported
