"""Questions to a map, one file each: a frozen record of what is asked, and the plan that answers it from one snapshot.

plan = Rays(origins, directions, max_range_m=30.0).plan(mapping.snapshot, Limits())
returns = plan.result(plan.parts())
"""
