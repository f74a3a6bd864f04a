"""All tables, by name."""

from __future__ import annotations

from potserver.evaluation.paper.choices import CHOICES
from potserver.evaluation.paper.rivalry import RIVALRY
from potserver.evaluation.paper.shipped import SHIPPED
from potserver.evaluation.paper.table import Table
from potserver.evaluation.paper.transfer import TRANSFER

TABLES: dict[str, Table] = {table.name: table for table in (*SHIPPED, *TRANSFER, *RIVALRY, *CHOICES)}
