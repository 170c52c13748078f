"""What of this machine the workflow can use, and what to do about the rest: `make doctor`.

`torch_builds` (cards, drivers and the builds of torch for them; standard library alone, since the set-up asks it before
anything is installed), `facts` (everything found out, in one record), `checks` (facts to findings, pure).
"""
