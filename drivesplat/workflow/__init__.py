"""What the rules ask: plan, stages, inputs, jobs, GPUs and measured costs."""

import os
import sys

# Stages have threads of their own. Snakemake asks OpenBLAS for as many again, which wait actively during small matrix
# products: a fifth of the processor time of `masks` with two threads.
if hasattr(sys.modules["__main__"], "snakemake"):  # in a rule's script, which imports this before numpy
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
