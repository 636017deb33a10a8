"""The paper's tables, and the time and memory that models need."""
