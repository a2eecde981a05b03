"""Worlds made from the Kuaishou logs, KuaiRec and KuaiRand."""
