"""The asyncio shell: takes proposals through the pipeline, owns questions and cells; decides nothing."""
