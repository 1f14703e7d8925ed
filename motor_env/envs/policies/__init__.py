"""Policies for Monitor and Probe, and scores of any policy. Begin with `rule_policies`."""
