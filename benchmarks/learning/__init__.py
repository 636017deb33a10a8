"""The paper's tables, and what models cost in time and memory."""
