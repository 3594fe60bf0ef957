"""The stand's error budget: what air, granite, target and table do to an image, in um and px."""
