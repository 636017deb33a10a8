"""What every training needs: run folders, chance without state, schedules, averages, devices."""
