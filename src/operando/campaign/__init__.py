"""Many tests: run on local processes or a Dask cluster, resumable, with one table and one report over all."""

from operando.campaign.config import Campaign, load_campaign
from operando.campaign.driver import run_campaign
from operando.data import explain_arguments

__all__ = ["Campaign", "load_campaign", "run_campaign"]

explain_arguments(__name__)
