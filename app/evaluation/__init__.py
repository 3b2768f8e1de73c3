"""Protocols, methods, metrics and reports that measure governance methods against each other (paper, Experiments).

```
generator ──▶ Trial ──▶ protocol ──▶ rows ──▶ metrics ──▶ results.json ──▶ report.html
              (seed)    paper │ physical       (one per trial and method)
```

A trial is a plain function of its seed; a method is data (`methods.Method`), so that every method runs the same code
with parts of it left out.
"""
