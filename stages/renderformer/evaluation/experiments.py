"""Which of the system's tables are shown how: table 1 beside the paper's figures, all others as runs side by side."""

from __future__ import annotations

from pipeline.experiments import Experiments, Order
from stages.renderformer.evaluation import ablation, comparison


def sweep(order: Order) -> int:
    return (ablation if order.table in ablation.names() else comparison).sweep(order)


def write(order: Order) -> int:
    write = ablation.write_table if order.table in ablation.names() else comparison.write_page
    return write(order.table, order.rows, order.overrides, order.out)


EXPERIMENTS = Experiments("table1_small", sweep, write)
