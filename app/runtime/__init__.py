"""The asyncio shell: takes proposals through the pipeline, owns escalations and cells; performs effects, decides nothing."""
