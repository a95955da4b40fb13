"""data_collection"""
