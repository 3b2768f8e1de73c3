"""Tests of everything. Nothing is collected as garbage before they are: what is imported stays, and looking is dear."""

import gc

gc.disable()
