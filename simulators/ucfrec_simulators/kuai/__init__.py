"""Environments made from the Kuaishou logs, KuaiRec and KuaiRand."""
